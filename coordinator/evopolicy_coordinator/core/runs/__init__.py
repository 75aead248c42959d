"""Runs and evaluations, from their creation to their result: submits, results, validation, selection."""
