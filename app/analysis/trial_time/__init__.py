"""Trial time: minutes that each controller was tested."""
