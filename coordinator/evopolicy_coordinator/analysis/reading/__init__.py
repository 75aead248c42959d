"""Run directories in, typed records out."""
