"""Fingerprints: everything that a worker's results depend on. Computed without importing a simulator.

An environment's fingerprint identifies our code by the adapter's revision and a digest of its source. The digest covers
the modules that every episode uses, the family's own module, and the accelerations that serve the environment. Tables
of environments and task texts are excluded, so that adding an environment changes no other's digest.
"""

from __future__ import annotations

import hashlib
import inspect
import platform
from collections.abc import Iterable
from functools import cache
from importlib import metadata
from pathlib import Path

import numpy as np

import evopolicy_common
from evopolicy_common.messages.worker import Fingerprint
from evopolicy_worker.environments.accelerations import ACCELERATIONS

PACKAGES = (
    *("numpy", "gymnasium", "gymnasium-robotics", "mujoco", "Box2D"),
    *("minigrid", "highway-env", "pygame-ce", "pandas"),
)
"""Distributions that Core16's environments are made of. An environment's description names those that decide its
results."""
REVISION = 1
"""Incremented when a change in the shared modules changes episodes. Scores of different revisions are not compared."""
_ROOT = Path(__file__).parents[2]
"""The package `evopolicy_worker`."""
_INTERFACE = "actions base gymnasium_adapter info rewards settings spaces"
_SHARED = (
    *(f"environments/interface/{name}.py" for name in _INTERFACE.split()),
    *("episodes/*.py", "slot_protocol/begun.py", "sandbox/inside/*.py"),
)
"""Modules that every episode uses."""


def fingerprint() -> Fingerprint:
    """This worker's fingerprint. Packages that are not installed are left out."""
    # SHA-256 over the worker's and the common package's own sources.
    digest = hashlib.sha256()
    for root in (Path(evopolicy_common.__path__[0]), _ROOT):
        for path in sorted(path for path in root.rglob("*") if path.suffix in (".py", ".toml", ".md")):
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes() + b"\0")
    # The instruction sets that numpy dispatches on here. Numerical libraries select their code by them.
    config = np.show_config(mode="dicts")
    simd = config.get("SIMD Extensions", {}) if isinstance(config, dict) else {}
    return Fingerprint(
        code_version=f"{evopolicy_common.__version__}+{digest.hexdigest()[:12]}",
        python=platform.python_version(),
        packages=versions(PACKAGES),
        cpu=f"{platform.machine()} {'+'.join([*simd.get('baseline', []), *simd.get('found', [])])}",
    )


def adapter(family: type, revision: int, gymnasium_id: str) -> str:
    """`REVISION.FAMILY_REVISION+DIGEST` of the code that plays environments of this class.

    `revision`: the family's. `gymnasium_id`: selects the accelerations that the digest includes.
    """
    ours = (each for each in family.__mro__ if each.__module__.startswith("evopolicy_worker."))
    own = {str(Path(inspect.getfile(each)).resolve()) for each in ours}
    served = [each.name.partition("_")[0] for each in ACCELERATIONS if each.serves(gymnasium_id)]
    helpers = [f"environments/accelerations/{name}_*.py" for name in dict.fromkeys(served)]
    helpers += ["environments/accelerations/specialise.py"] if served else []
    helpers += getattr(family, "sources", ())
    files = {*own, *(str(path) for pattern in (*_SHARED, *helpers) for path in _matching(pattern))}
    return f"{REVISION}.{revision}+{_digest(tuple(sorted(files)))}"


@cache
def _digest(files: tuple[str, ...]) -> str:
    digest = hashlib.sha256()
    for path in map(Path, files):
        digest.update(str(path.relative_to(_ROOT.resolve())).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


def versions(distributions: Iterable[str]) -> dict[str, str]:
    """Installed versions by lowercase name. Distributions that are not installed are left out."""
    installed = {name.lower(): _version(name) for name in distributions}
    return {name: version for name, version in installed.items() if version}


@cache
def _version(name: str) -> str:
    """The installed version; empty when there is none."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def _matching(pattern: str) -> list[Path]:
    paths = sorted(path.resolve() for path in _ROOT.glob(pattern) if path.is_file())
    if not paths:
        raise LookupError(f"no module of the adapters is called {pattern}")
    return paths
