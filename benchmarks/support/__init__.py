"""Modules that the benchmark scripts share: none of these modules is a script, and `make bench` runs none of them."""
