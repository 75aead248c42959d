"""Dotted paths into JSON documents of which nothing is known."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any


def values(document: Any, path: str) -> Iterator[Any]:
    """Yields every value at a dotted path; nothing for an empty path. `*` stands for each element of a list, and
    `[name=value]` for an object with that value."""
    if not path:
        return
    if path.startswith("["):
        condition, _, rest = path[1:].partition("]")
        name, _, wanted = condition.partition("=")
        if isinstance(document, dict) and document.get(name) == wanted:
            yield from values(document, rest.removeprefix("."))
        return
    head, _, rest = path.partition(".")
    if head == "*":
        inner: Iterable[Any] = document if isinstance(document, list) else ()
    elif isinstance(document, dict) and head in document:
        inner = (document[head],)
    else:
        return
    for value in inner:
        if rest:
            yield from values(value, rest)
        else:
            yield value
