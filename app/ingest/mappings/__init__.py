"""Column mappings: how tables that no decoder knows are read in one study, stated once by a person who saw a preview."""
