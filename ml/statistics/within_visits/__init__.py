"""The visit as the unit of evidence: contrasts to the same visit's cDBS, exact tests, sensitivity analyses and mixed models."""
