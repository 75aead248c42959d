"""Agents and hidden jobs keep each other from the same kernels: permits, how gateways ask for them, and who goes first."""
