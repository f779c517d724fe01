"""After the visit: what the tested controllers did against cDBS."""
