"""Characteristics of a participant as the paper's appendix lists them: leads, symptoms, hand, medication. Versioned; no identity."""
