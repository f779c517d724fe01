"""The betaloop service: one folder per phase of the study, each with the same layers."""

__version__ = "0.1.0"
