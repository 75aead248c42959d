"""Sweeps: agents × environments × repeats, unattended, on one host or several, stopped and resumed."""
