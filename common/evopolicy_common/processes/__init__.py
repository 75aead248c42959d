"""Processes and the machine: children, temporary folders, checks before a command begins."""
