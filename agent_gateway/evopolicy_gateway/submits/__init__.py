"""Submits, from a request's bytes to committed feedback."""
