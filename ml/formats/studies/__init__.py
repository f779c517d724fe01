"""A whole study at once: the sheet of its sessions, and which file each row is of."""
