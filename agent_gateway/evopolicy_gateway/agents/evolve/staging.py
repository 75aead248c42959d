"""Writes `system/`: the controllers' code once, and the candidates of each submit."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from evopolicy_gateway.agents.evolve.evolved.policy import CANDIDATES_FILE
from evopolicy_gateway.agents.evolve.search import Candidate

PACKAGE = "evolved"
ENTRY_POINT = f'"""Plays the candidates listed in `{CANDIDATES_FILE}`."""\n\nfrom {PACKAGE}.policy import Policy as Policy\n'  # noqa: E501


def stage_code(system: Path) -> None:
    """Copies the policy's code into `system`, and replaces its `policy.py`."""
    target = system / PACKAGE
    target.mkdir(parents=True, exist_ok=True)
    source = resources.files("evopolicy_gateway.agents.evolve") / PACKAGE
    for item in source.iterdir():
        if item.name.endswith(".py"):
            with resources.as_file(item) as path:
                shutil.copyfile(path, target / item.name)
    _replace(system / "policy.py", ENTRY_POINT)


def stage_candidates(system: Path, candidates: Sequence[Candidate], schedule: Sequence[int]) -> None:
    """Writes `candidates`, and which of them plays each episode of the next submit."""
    plan = {"candidates": [c.as_json() for c in candidates], "schedule": list(schedule)}
    _replace(system / CANDIDATES_FILE, json.dumps(plan))


def _replace(path: Path, text: str) -> None:
    """Replaces the file atomically: a snapshot may be taken at any moment."""
    temporary = path.with_name(path.name + ".new")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)
