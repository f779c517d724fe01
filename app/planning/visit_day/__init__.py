"""The clinic day: entries on a tablet next to the participant, session by session of the approved plan."""
