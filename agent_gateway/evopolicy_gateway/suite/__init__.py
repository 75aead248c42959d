"""Sweeps: agents × environments × repeats, unattended, on one or several hosts, with stop and resume."""
