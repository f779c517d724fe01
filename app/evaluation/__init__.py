"""Phase III, evaluate: estimates of every policy and their ranking."""
