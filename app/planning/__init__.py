"""Phase IV, plan: visit plans, approval, the printed sheet."""
