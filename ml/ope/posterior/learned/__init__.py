"""What a population of virtual patients teaches about differences to cDBS: evidence, networks, and their constants."""
