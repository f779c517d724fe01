"""Training and distillation as the child processes run them, and their configurations."""
