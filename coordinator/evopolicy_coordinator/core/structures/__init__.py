"""Structures that keep their own invariants and know nothing of runs, workers and jobs: deadlines, stories, ledgers, long polls."""
