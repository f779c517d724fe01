"""The science of betaloop: MDP, learning, evaluation, statistics. Knows no SQL, no HTTP and nothing of `app`."""
