"""Structures with invariants of their own that know nothing of runs, workers and jobs: deadlines,
traces, ledgers, polls."""
