"""The samples of a session with their times, as files that other programs read: Parquet and NWB."""
