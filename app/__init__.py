"""The betaloop service: one folder per phase of the study, each with the same rooms."""

__version__ = "0.1.0"
