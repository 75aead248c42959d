"""Examples that come with the package: commands find them where messages and the documentation name them."""

from __future__ import annotations

from pathlib import Path


def found(path: str | Path, started_in: Path) -> Path:
    """`path` from where the operator stands, or the package's own where nothing is there, such as `examples/policies`."""
    here = started_in / path
    if here.exists() or Path(path).parts[:1] != ("examples",):
        return here
    package = Path(__file__).parent
    # In a wheel they lie in the package; in a checkout at its top.
    own = (root / path for root in (package, package.parents[1]))
    return next((each for each in own if each.exists()), here)
