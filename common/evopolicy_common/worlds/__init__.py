"""Altered rules of an environment, and policies that undo them."""
