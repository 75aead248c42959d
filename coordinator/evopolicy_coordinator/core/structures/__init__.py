"""Structures with invariants of their own, independent of runs, workers and jobs: deadlines, ledgers, polls."""


class InvariantError(AssertionError):
    """The core's state is inconsistent: a bug."""
