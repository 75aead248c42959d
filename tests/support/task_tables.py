"""The tables of task texts, read back, and the components of spaces that they have to cover."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator

import numpy as np

from evopolicy_common.messages.environment import SpaceSchema


def leaves(schema: SpaceSchema, path: str = "") -> Iterator[tuple[str, SpaceSchema]]:
    """Path and schema of every leaf space; the path of a space that is no Dict is empty."""
    if schema["type"] == "Dict":
        for key, part in schema["spaces"].items():
            yield from leaves(part, f"{path}.{key}" if path else key)
    elif schema["type"] == "Tuple":
        for index, part in enumerate(schema["spaces"]):
            yield from leaves(part, f"{path}.{index}" if path else f"{index}")
    else:
        yield path, schema


def components(schema: SpaceSchema) -> set[tuple[str, tuple[int, ...]]]:
    """Every flat component of an observation or action: path of its leaf and index in it."""
    found: set[tuple[str, tuple[int, ...]]] = set()
    for path, leaf in leaves(schema):
        shape: tuple[int, ...] = ()
        if leaf["type"] in ("Box", "Image"):
            shape = tuple(leaf["shape"])
        elif leaf["type"] == "MultiDiscrete":
            shape = np.shape(leaf["nvec"])
        elif leaf["type"] == "MultiBinary":
            shape = tuple(np.atleast_1d(leaf["n"]).tolist())
        # The parts of a tuple are told by a first index, and a lone number is component 0.
        name, first = ("", (int(path),)) if path.isdigit() else (path, ())
        shape = shape or ((1,) if not path else ())
        found.update((name, (*first, *index)) for index in itertools.product(*map(range, shape)))
    return found


_SELECTOR = re.compile(r"^(?:(?P<path>[A-Za-z_][\w. ]*)(?:\[(?P<inner>[^\]]*)\])?|(?P<bare>[\d–, ]+))$")


def selected(selector: str) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Components that the first cell of a row names: `3`, `0–4`, `0–83, 0–2`, `image[0–6, 0]`, `direction`."""
    match = _SELECTOR.match(selector)
    assert match, f"cannot read the component {selector!r}"
    spans = match["bare"] or match["inner"] or ""
    ranges = []
    for span in filter(None, (part.strip() for part in spans.split(","))):
        first, _, last = span.partition("–")
        ranges.append(range(int(first), int(last or first) + 1))
    for index in itertools.product(*ranges):
        yield match["path"] or "", index


def table(text: str, heading: str) -> list[list[str]]:
    """Cells of the first table under `## heading`, without its head."""
    match = re.search(rf"^## {heading}\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    assert match, f"no section {heading!r}"
    lines = [line for line in match[1].splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    widths = {len(row) for row in rows}
    assert len(widths) == 1, f"rows of different widths under {heading!r}: {widths}"
    return rows[2:]
