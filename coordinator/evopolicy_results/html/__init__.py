"""Pages of reports and sites."""

from __future__ import annotations

from evopolicy_common.terminal import harmless


def visible(value: object) -> object:
    """What a template shows for a value: a text without control characters and marks that reverse what follows, markup as it is."""
    return harmless(value) if type(value) is str else value
