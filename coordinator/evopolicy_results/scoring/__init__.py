"""Scores, ranks and normalised scores, and the paper's own numbers to test them against."""
