"""The protocol of a visit: its rules by name, the order of its sessions."""
