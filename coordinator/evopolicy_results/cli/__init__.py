"""Commands on finished runs: reports, checks, re-scores and published results."""
