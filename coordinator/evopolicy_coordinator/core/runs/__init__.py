"""What runs and evaluations are, from their creation to their result: submits, results, validation, selection, audits."""
