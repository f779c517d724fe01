"""Is beta a biomarker in this participant, how things went over the months, and after a dose of medication."""
