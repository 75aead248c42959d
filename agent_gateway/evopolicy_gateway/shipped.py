"""Files that come with the package: commands find them where messages and the documentation name them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

NAMES = ("examples/policies", "examples/agents", "examples/notebooks", "deploy", "docs", "constraints.txt")
"""Shipped files by their path in the repository; `pyproject.toml` packs them under the same path."""
_NOT_TEXT = ("images", "_site", "__pycache__")


def found(path: str | Path, started_in: Path) -> Path:
    """`path` relative to the current folder if it exists there, otherwise the package's copy, such as
    `examples/policies`."""
    here = started_in / path
    if here.exists() or not any(Path(path).is_relative_to(name) for name in NAMES):
        return here
    return own(path) or here


def own(path: str | Path) -> Path | None:
    """The package's own file or folder of that name, if it has one."""
    package = Path(__file__).parent
    # In a wheel they lie in the package; in a checkout at its top.
    places = (root / path for root in (package, package.parents[1]))
    return next((each for each in places if each.exists()), None)


def files() -> Iterator[tuple[str, Path]]:
    """Every shipped file: its name in messages and documentation, and where it is."""
    for name in NAMES:
        place = own(name)
        if place is None:
            continue
        for file in [place] if place.is_file() else sorted(place.rglob("*")):
            inside = file.relative_to(place).parts
            if file.is_file() and not set(inside) & set(_NOT_TEXT):
                yield "/".join((name, *inside)), file
