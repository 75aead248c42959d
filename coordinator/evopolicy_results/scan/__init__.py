"""Finds places in an agent's log or code that a person should look at: signals with the evidence quoted, never
verdicts."""
