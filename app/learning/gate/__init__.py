"""The gate of the replay buffer: when sessions of learned policies may enter it."""
