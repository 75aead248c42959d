"""Requests between processes: keys, encoding, sessions, credentials, refusals."""
