"""What of this software plays an environment, for its fingerprint: the adapter's revision and a digest of its code.

The digest covers the modules that every episode goes through, the family's own, and the accelerations that serve the
environment; tables of environments and task texts are no part of it, so that adding an environment changes no other's.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Iterable
from functools import cache
from importlib import metadata
from pathlib import Path

import evopolicy_worker
from evopolicy_worker.environments.accelerations import ACCELERATIONS

REVISION = 1
"""Counts up when the modules that all environments share change what is played: scores of several are not compared."""
_ROOT = Path(evopolicy_worker.__path__[0])
_SHARED = (
    *(
        f"environments/{name}.py"
        for name in ("actions", "base", "gymnasium_adapter", "info", "observations", "settings", "spaces")
    ),
    "episodes/*.py",
    "sandbox/inside/*.py",
)
"""Modules that every episode goes through."""


def adapter(family: type, revision: int, gymnasium_id: str) -> str:
    """`REVISION.FAMILY_REVISION+DIGEST` of what plays environments of that class, or that id where accelerations serve it."""
    own = {str(Path(inspect.getfile(each)).resolve()) for each in family.__mro__ if _is_ours(each)}
    served = [each.name.partition("_")[0] for each in ACCELERATIONS if each.serves(gymnasium_id)]
    helpers = [f"environments/accelerations/{name}_*.py" for name in dict.fromkeys(served)]
    helpers += ["environments/accelerations/specialise.py"] if served else []
    files = {*own, *(str(path) for pattern in (*_SHARED, *helpers) for path in _matching(pattern))}
    return f"{REVISION}.{revision}+{_digest(tuple(sorted(files)))}"


@cache
def _digest(files: tuple[str, ...]) -> str:
    digest = hashlib.sha256()
    for path in map(Path, files):
        digest.update(str(path.relative_to(_ROOT.resolve())).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


def versions(distributions: Iterable[str]) -> dict[str, str]:
    """The installed versions by lowercase name; what is not installed is left out."""
    found: dict[str, str] = {}
    for name in distributions:
        try:
            found[name.lower()] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def _is_ours(family: type) -> bool:
    return family.__module__.startswith(f"{evopolicy_worker.__name__}.")


def _matching(pattern: str) -> list[Path]:
    found = sorted(path.resolve() for path in _ROOT.glob(pattern))
    if not found:
        raise LookupError(f"no module of the adapters is called {pattern}")
    return found
