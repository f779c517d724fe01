"""Phase II, learn: buffer snapshots, policies, training and distillation."""
