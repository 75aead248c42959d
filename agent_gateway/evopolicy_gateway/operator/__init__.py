"""Operators' commands: several runs at once, requests to a cluster, and its live view."""
