"""The worker's fingerprint: everything that its results depend on. Computed without importing a simulator."""

from __future__ import annotations

import hashlib
import platform
from pathlib import Path

import numpy as np

import evopolicy_common
from evopolicy_common.messages.worker import Fingerprint
from evopolicy_worker.environments.interface.adapters import versions

PACKAGES = (
    *("numpy", "gymnasium", "gymnasium-robotics", "mujoco", "Box2D"),
    *("minigrid", "highway-env", "pygame-ce", "pandas"),
)
"""Distributions that Core16's environments are made of. An environment's description names those that decide its
results."""


def fingerprint() -> Fingerprint:
    """This worker's fingerprint. Packages that are not installed are left out."""
    return Fingerprint(
        code_version=f"{evopolicy_common.__version__}+{_source_digest()[:12]}",
        python=platform.python_version(),
        packages=versions(PACKAGES),
        cpu=f"{platform.machine()} {_simd_features()}",
    )


def _source_digest() -> str:
    """SHA-256 over the worker's and the common package's own sources."""
    digest = hashlib.sha256()
    for root in (Path(evopolicy_common.__path__[0]), Path(__file__).parents[2]):
        for path in sorted(path for path in root.rglob("*") if path.suffix in (".py", ".toml", ".md")):
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _simd_features() -> str:
    """The instruction sets that numpy dispatches on here. Numerical libraries select their code by them."""
    config = np.show_config(mode="dicts")
    simd = config.get("SIMD Extensions", {}) if isinstance(config, dict) else {}
    return "+".join([*simd.get("baseline", []), *simd.get("found", [])])
