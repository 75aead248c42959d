"""Signals in an agent's log or code that a person should read, with the evidence quoted: never verdicts."""
