"""The clinic day: what a tablet takes down beside the participant, session by session of the approved plan."""
