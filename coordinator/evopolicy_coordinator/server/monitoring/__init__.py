"""Monitoring of a running coordinator: its metrics, and stalls of its event loop."""
