"""Background jobs of every kind, their REST routes and pages, and the work between two visits: train, distil, evaluate, rank."""
