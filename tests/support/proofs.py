"""The families of environments whose proof of life is tested: `tests/families/table.toml`, a row each."""

from __future__ import annotations

import hashlib
import tomllib
from pathlib import Path

import msgspec
import pytest

from evopolicy_common.catalogue import installs
from evopolicy_worker.environments import missing
from evopolicy_worker.environments.browser import chromium

FOLDER = Path(__file__).resolve().parents[1] / "families"
N_DRAWN, N_CASES = 32, 16
"""Cases of each family, and how many of them are played unless its row says otherwise."""


class Proof(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One family."""

    family: str
    """Name of its suite."""
    env: str
    """Where a policy of ours beats random actions, and which an agent plays in a whole run."""
    agent: str = "evolve"
    """That agent."""
    check: tuple[str, ...]
    """The environments that `check-env` plays."""
    check_steps: int = 100
    """Steps of each of these."""
    cases: int = N_CASES
    """How many of the drawn cases are played; fewer where an episode takes seconds."""
    steps: int = 0
    """The most steps of an episode, of the policy's and of random actions; 0: as many as the environment gives."""

    @property
    def policy(self) -> Path:
        """The folder of the policy."""
        return FOLDER / "policies" / self.env.replace("/", "_")

    @property
    def seeds(self) -> list[int]:
        """The cases that the policy is measured on."""
        return drawn(self.family)[: self.cases]


def table() -> list[Proof]:
    """All families, in the order of the file."""
    rows = tomllib.loads((FOLDER / "table.toml").read_text())["proof"]
    return msgspec.convert(rows, list[Proof])


def together() -> list[Proof]:
    """The rows of families that share one installation; a family that excludes the others' packages has tests with its
    own."""
    return [each for each in table() if not installs.installs()[installs.family_of(each.env)].pins]


def demand(env: str) -> None:
    """Fails where this installation lacks a package of the environment: `make families` installs them all. Skips
    where Chromium is missing, which only root can install."""
    lacking = missing(env)
    if lacking and lacking == chromium.lacking():
        pytest.skip(f"{env} needs {lacking}")
    assert not lacking, f"{env} needs {lacking}"


def drawn(family: str) -> list[int]:
    """The seeds of a family's cases: drawn by its name alone, so that nobody chose them."""
    return [
        int.from_bytes(hashlib.sha256(f"proof of life {family} {k}".encode()).digest()[:4], "big") >> 1
        for k in range(N_DRAWN)
    ]
