"""Structures with invariants of their own, independent of runs, workers and jobs: deadlines, traces, ledgers, polls."""
