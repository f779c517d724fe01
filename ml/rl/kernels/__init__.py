"""What the algorithms compute with: networks, K of them side by side, batches. Private to `ml.rl`; its face exports what others may use."""
