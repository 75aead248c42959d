"""The error of a broken invariant."""


class InvariantError(AssertionError):
    """The core's state is inconsistent: a bug."""
