"""QoCs from uploaded files."""
