"""Structures with invariants of their own, independent of runs, workers and jobs: deadlines, ledgers, polls."""
