"""Numerical parts of the algorithms: networks, K of them side by side, batches. Private to `ml.rl`, which exports what others may use."""
