"""What `benchmarks/suite.py` gives to pytest."""
