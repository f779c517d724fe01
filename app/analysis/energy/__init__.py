"""What stimulation took, by several measures, each with its definition; and what a battery would make of it."""
