"""An installation of processes that benchmarks kill and load, and callers that write to it."""
