"""The posterior over policies: structures averaged by what they predict, a Gaussian process over candidates, updated by tested sessions."""
