"""The study itself: participants, settings, visits, sessions, recordings, traces and QoCs."""
