"""Who may join: a bounded number of workers a token, each under a name of its machine.

Attacks, each with its defence:
- registers ever more worker names, or large descriptions under each: 4,096 workers and 256 MiB of
  descriptions for one token.
- uses another machine's worker name to have it blamed: a name stays bound to its machine while the worker is connected.
"""

from __future__ import annotations

from typing import Any

import pytest
from rigs.core_rig import Rig, describe, fingerprint

from evopolicy_common.messages import worker as wire
from evopolicy_coordinator.core.leasing import fleet
from evopolicy_coordinator.core.workers.membership import FORGET_S


def join(rig: Rig, name: str, *, version: str = "1", machine: str = "", size: int = 0, **more: Any) -> Any:
    return rig.ask(
        wire.Register,
        worker=name,
        session=f"{name}-s{rig.request()}",
        slots=1,
        tiers=("bwrap",),
        environments=(describe(),),
        fingerprint=fingerprint(version),
        machine=machine,
        size=size,
        **more,
    )


def joins(rig: Rig, name: str, **more: Any) -> bool:
    answer = join(rig, name, **more)
    assert isinstance(answer, wire.Registered) or answer.status == "too_large"
    return isinstance(answer, wire.Registered)


def test_a_token_lets_only_so_many_names_join(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet, "MAX_WORKERS", 3)
    rig = Rig()
    assert [joins(rig, f"w{n}") for n in range(5)] == [True] * 3 + [False] * 2
    assert "certs issue" in join(rig, "w9").message
    assert joins(rig, "w0"), "a worker may join again"
    assert joins(rig, "other", machine="lab"), "other machines have room of their own"
    rig.pass_time(rig.settings.lease_ttl_s + rig.settings.adoption_s + FORGET_S + 60.0)
    assert joins(rig, "w9")


def test_descriptions_of_a_token_have_a_bounded_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet, "MAX_DESCRIBED_BYTES", 100)
    rig = Rig()
    assert joins(rig, "w0", version="1", size=40)
    assert joins(rig, "w1", version="1", size=40), "workers that tell the same share it"
    assert joins(rig, "w2", version="1", size=40)
    assert joins(rig, "w3", version="2", size=40)
    assert not joins(rig, "w4", version="3", size=40)
    assert not joins(rig, "w0", version="3", size=40), "nor in the place of one that stays in use"
    assert joins(rig, "w3", version="3", size=40), "but in the place of one that does not"
    assert not joins(rig, "w5", version="3", undescribed=("toy/another-one-of-many",) * 5)
    assert not joins(rig, "w5", version="3", failed_environments={"my/x": "why" * 50})


def test_a_machine_cannot_play_under_the_name_of_anothers_worker() -> None:
    """It would have the other machine blamed for what it reports."""
    rig = Rig()
    assert isinstance(join(rig, "w1", machine="good"), wire.Registered)
    refused = join(rig, "w1", machine="bad")
    assert (refused.status, "another machine" in refused.message) == ("name_taken", True)
    assert isinstance(join(rig, "w1", machine="good"), wire.Registered)
