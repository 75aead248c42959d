"""Worlds that were accepted: the order and the rule are fixed, and the journal decides which ones are
played."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from evopolicy_common.errors import ConfigError
from evopolicy_common.records.journal import digest, epoch_of
from evopolicy_coordinator import worlds
from evopolicy_coordinator.splits import SplitSource

SECRET = b"s" * 32
COUNTS: Any = {"train": 2, "validation": 1, "heldout": 1}
BASE = worlds.Base(
    epoch=epoch_of(SECRET), env="gym/acrobot", policy="d" * 64, random=-500.0, canonical=-100.0
)


def candidate(number: int, *, accepted: bool, epoch: str = BASE.epoch) -> worlds.Candidate:
    return worlds.Candidate(
        epoch=epoch,
        env=BASE.env,
        number=number,
        canonical=-500.0,
        ceiling=-100.0 if accepted else None,
        variants=1,
        accepted=accepted,
    )


@pytest.mark.parametrize(
    ("canonical", "ceiling", "loses", "reaches"),
    [(-300.0, -180.0, True, True), (-299.0, -180.5, False, False), (-600.0, 0.0, True, True)],
)
def test_half_of_the_distance_is_lost_and_four_fifths_are_reached(
    canonical: float, ceiling: float, loses: bool, reaches: bool
) -> None:
    assert worlds.loses(BASE, canonical) is loses
    assert worlds.reaches(BASE, ceiling) is reaches


def test_nothing_is_accepted_where_the_policy_equals_random() -> None:
    base = worlds.Base(epoch="e", env="gym/acrobot", policy="d" * 64, random=5.0, canonical=5.0)
    assert not worlds.loses(base, -100.0)


def test_a_coordinator_plays_the_accepted_candidates_in_order(tmp_path: Path) -> None:
    journal = tmp_path / worlds.JOURNAL
    source = SplitSource(data=None, secret=SECRET, journal=journal)

    def played(n: int) -> str:
        cases = source.splits("core16-worlds", f"gym/acrobot@w{n}", COUNTS).cases("heldout")
        assert cases[0].options is not None
        return str(cases[0].options["world"])

    assert [played(n) for n in (1, 2, 3)] == [worlds.key_of(SECRET, BASE.env, n) for n in (0, 1, 2)]
    worlds.append(journal, candidate(0, accepted=True, epoch="another"))
    worlds.append(journal, BASE)
    for number, accepted in enumerate((False, True, False, True)):
        worlds.append(journal, candidate(number, accepted=accepted))
    assert [played(n) for n in (1, 2)] == [worlds.key_of(SECRET, BASE.env, n) for n in (1, 3)]
    with pytest.raises(ConfigError, match="4 candidates were tried and 2 accepted") as refused:
        played(3)
    root = worlds.key_of(SECRET, BASE.env, 0).partition("-")[0]
    assert root not in str(refused.value)
    assert root not in journal.read_text()
    assert journal.stat().st_mode & 0o777 == 0o600


def test_an_environment_without_a_known_policy_has_no_world(tmp_path: Path) -> None:
    journal = tmp_path / worlds.JOURNAL
    worlds.append(journal, worlds.Base(epoch=BASE.epoch, env=BASE.env, policy=""))
    with pytest.raises(ConfigError, match="no accepted rules"):
        worlds.number_of("gym/acrobot@w1", SECRET, journal)


@pytest.mark.parametrize("numbers", [[977], [0, 2], [1, 0], [*range(17)], [0, 0]])
def test_trials_out_of_their_order_are_refused(tmp_path: Path, numbers: list[int]) -> None:
    """Attack: an operator writes the trials by hand, to choose rules freely. Defence: they are candidates 0 to 15 in
    order, and a run commits to their digest."""
    journal = tmp_path / worlds.JOURNAL
    worlds.append(journal, BASE)
    for number in numbers:
        worlds.append(journal, candidate(number, accepted=True))
    with pytest.raises(ConfigError, match="are not 0 to 15 in order"):
        worlds.number_of("gym/acrobot@w1", SECRET, journal)


def test_cases_of_a_world_come_with_the_digest_of_its_trials(tmp_path: Path) -> None:
    journal = tmp_path / worlds.JOURNAL
    source = SplitSource(data=None, secret=SECRET, journal=journal)

    def trials(env: str = "gym/acrobot@w1") -> str:
        return source.splits("core16-worlds", env, COUNTS).trials

    assert trials() == trials("gym/acrobot") == ""
    worlds.append(journal, BASE)
    worlds.append(journal, candidate(0, accepted=True))
    first = trials()
    assert first == digest(journal.read_bytes())
    worlds.append(journal, candidate(1, accepted=False))
    assert trials() == digest(journal.read_bytes()) != first
    assert trials("gym/acrobot") == ""


def test_candidates_of_one_environment_share_a_root() -> None:
    first, second = (worlds.key_of(SECRET, "gym/acrobot@w1", n) for n in (0, 1))
    assert first.partition("-")[0] == second.partition("-")[0]
    assert first.partition("-")[2] == "0"
    assert worlds.key_of(SECRET, "gym/ant5", 0).partition("-")[0] != first.partition("-")[0]
    assert worlds.key_of(b"t" * 32, "gym/acrobot", 0).partition("-")[0] != first.partition("-")[0]


def test_a_damaged_journal_is_named(tmp_path: Path) -> None:
    journal = tmp_path / worlds.JOURNAL
    journal.write_text("{}\n")
    with pytest.raises(ConfigError, match="no journal of worlds"):
        worlds.read_journal(journal)
