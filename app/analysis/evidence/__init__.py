"""What every session of a participant contributes to the analyses, read at once and kept until one of its rows changes."""
