"""The samples of a session on the screen: extremes at the resolution of the page, and the spectrogram, for any stretch of time."""
