"""The study in silico: the whole trial loop on the synthetic participants, through the service's own functions."""
