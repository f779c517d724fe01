"""The control loop on the tablet: a signed bundle, its sources of beta amplitudes, and what a session means for a battery."""
