"""Operators' commands: several runs at once, the questions that they ask a cluster, and the view of it."""
