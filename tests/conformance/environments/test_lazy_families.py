"""A worker that offers very many environments imports and describes only those that are played."""

from __future__ import annotations

import asyncio
import json
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import proofs
import pytest

from evopolicy_common import catalogue
from evopolicy_common.catalogue import installs
from evopolicy_common.errors import BrokenEnvironmentError
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_worker import capabilities
from evopolicy_worker.environments import describe, process_environment, registry
from evopolicy_worker.environments.browser import page

pytestmark = pytest.mark.families

SIMULATORS = {name: {*row.modules} - {"gymnasium", "pygame"} for name, row in installs.installs().items()}
"""Packages that only these families' environments import."""
MAKES = """
import json, sys
from evopolicy_worker import environments
environment = environments.make(sys.argv[1])
environment.close()
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""
SORTS = """
import json, sys
from pathlib import Path
from evopolicy_common import catalogue
from evopolicy_common.catalogue import installs
from evopolicy_worker import capabilities
_, now, later = capabilities.sorted_out(catalogue.entries(), capabilities.Cache("code", Path(sys.argv[1])))
assert now == [] and len(later) > 390
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""


def imported(code: str, argument: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, argument],
        env=process_environment() | {"PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return set(json.loads(done.stdout.splitlines()[-1]))


@pytest.mark.parametrize("proof", proofs.together(), ids=lambda proof: proof.family)
def test_one_family_imports_no_other(proof: proofs.Proof) -> None:
    proofs.demand(proof.env)
    others = set().union(*SIMULATORS.values()) - SIMULATORS[installs.family_of(proof.env)]
    assert imported(MAKES, proof.env) & others == set()


def test_what_is_to_be_described_is_found_without_any_simulator(tmp_path: Path) -> None:
    assert imported(SORTS, str(tmp_path)) & (set().union(*SIMULATORS.values()) | {"gymnasium"}) == set()


class Scripted:
    """A slot that describes toys, and breaks on others."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.starts = 0

    async def start(self) -> None:
        self.starts += 1

    async def describe(self, env_ids: Sequence[str]) -> tuple[EnvironmentDescription, ...]:
        self.asked += env_ids
        if not env_ids[0].startswith("toy/"):
            raise BrokenEnvironmentError(f"environment {env_ids[0]}, reset: it hangs")
        return tuple(map(describe, env_ids))


def test_few_are_described_at_the_start_and_many_on_first_use(tmp_path: Path) -> None:
    cache = capabilities.Cache("code", tmp_path)
    ids = list(catalogue.entries())
    assert capabilities.sorted_out(ids[:16], cache) == ([], ids[:16], [])
    assert capabilities.sorted_out([*ids, "my_pkg:Env-v0"], cache) == ([], ["my_pkg:Env-v0"], ids)
    toys = ["toy/line", "toy/maze"]
    found, _ = asyncio.run(capabilities.describe_all(toys, Scripted(), cache))
    assert capabilities.sorted_out(toys, cache) == (list(found), [], [])
    known, _, later = capabilities.sorted_out(ids, cache)
    assert [each.env for each in known] == toys
    assert len(later) == len(ids) - 2


def test_a_description_holds_for_one_fingerprint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = capabilities.Cache("code", tmp_path)
    description = describe("toy/line")
    cache.put(description)
    assert cache.get("toy/line") == description
    assert capabilities.Cache("other code", tmp_path).get("toy/line") is None
    monkeypatch.setattr(registry, "versions", lambda names: {"numpy": "0"})
    assert cache.get("toy/line") is None
    monkeypatch.undo()
    entry = catalogue.entry("toy/line")
    monkeypatch.setattr(catalogue, "entry", lambda env_id: msgspec.structs.replace(entry, title="Another"))
    assert cache.get("toy/line") is None
    monkeypatch.undo()
    for file in tmp_path.iterdir():
        file.write_bytes(b"{")
    assert cache.get("toy/line") is None


@pytest.mark.parametrize(
    "env_id", ["miniwob/click-test-v1", "gymnasium/MiniWorld-OneRoom-v0", "my_pkg:Env-v0"]
)
def test_facts_of_a_made_environment_are_neither_kept_nor_forced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, env_id: str
) -> None:
    def start(*given: object) -> None:
        raise AssertionError("a browser is started outside the jail")

    monkeypatch.setattr(page, "Chromium", start)
    cache = capabilities.Cache("code", tmp_path)
    cache.put(msgspec.structs.replace(describe("toy/line"), env=env_id))
    assert not list(tmp_path.iterdir())
    assert cache.get(env_id) is None


def test_a_description_of_another_environment_is_not_taken(tmp_path: Path) -> None:
    cache = capabilities.Cache("code", tmp_path)
    cache.put(describe("toy/line"))
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes().replace(b'"env":"toy/line"', b'"env":"toy/maze"'))
    assert cache.get("toy/line") is None


def test_an_undescribable_environment_is_left_out_and_others_are_offered(
    tmp_path: Path,
) -> None:
    slot = Scripted()
    found, failed = asyncio.run(capabilities.describe_all(["gym/ant5", "toy/line"], slot))
    assert [each.env for each in found] == ["toy/line"]
    assert slot.starts == 2
    assert list(failed) == ["gym/ant5"]
    assert "gym/ant5, reset: it hangs" in failed["gym/ant5"]


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"env": "toy/maze"}, "environment toy/line: its process described another one"),
        (
            {"obs_space": {"type": "Dict", "spaces": {1: {"type": "Discrete", "n": 2}}}},
            "environment toy/line, observation_space: a key in it is 1; keys have to be texts; make it simpler",
        ),
        (
            {"action_space": {"low": [0.0] * (1 << 20)}},
            "environment toy/line, action_space: it is made of more than 1,048,576 values; make it simpler",
        ),
        (
            {"obs_space": {"low": [0.1] * (1 << 17)}},
            "environment toy/line: its description has 1,.* bytes, and 1,048,576 are the limit; give elements of a Box",
        ),
    ],
)
def test_an_oversized_description_is_left_out_and_others_are_offered(
    changed: dict[str, Any], why: str
) -> None:
    """The worker could not register with it, or the coordinator not store it."""

    class Odd(Scripted):
        async def describe(self, env_ids: Sequence[str]) -> tuple[EnvironmentDescription, ...]:
            (found,) = await super().describe(env_ids)
            return (msgspec.structs.replace(found, **changed) if found.env == "toy/line" else found,)

    found, failed = asyncio.run(capabilities.describe_all(["toy/line", "toy/maze"], Odd()))
    assert [each.env for each in found] == ["toy/maze"]
    assert re.search(why, failed["toy/line"])
