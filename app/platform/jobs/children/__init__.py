"""Child processes of compute steps: how they start, report, share slots and are stopped."""
