"""Policy seeds, and the decision what to do about a job that was not finished."""

from __future__ import annotations

import hashlib
import hmac

import hypothesis.strategies as st
from hypothesis import given

from evopolicy_common.messages.environment import Case
from evopolicy_coordinator.core.contract.settings import CoreSettings
from evopolicy_coordinator.core.leasing.jobs import (
    backoff_s,
    decide,
    occurrences,
    policy_seed,
    reference_seed,
)

SETTINGS = CoreSettings()


def test_a_policy_seed_is_the_keyed_hash_that_the_protocol_names() -> None:
    expected = hmac.new(b"secret", b"3|train|17|1", hashlib.sha256).digest()[:16]
    assert policy_seed(b"secret", 3, "train", 17, 1) == expected


def test_no_two_episodes_of_a_run_share_a_policy_seed() -> None:
    """Attack: relies on the random numbers of an earlier submit. Defence: a keyed hash of submit, split,
    case, and occurrence."""
    seeds = {
        policy_seed(b"s", submit, split, case, time)
        for submit in range(-1, 4)
        for split in ("train", "validation", "heldout", "random")
        for case in range(12)
        for time in range(3)
    }
    assert len(seeds) == 5 * 4 * 12 * 3


def test_a_reference_seed_follows_from_split_and_case_alone() -> None:
    expected = hashlib.sha256(b'evopolicy random reference\0["heldout", 7, {"a": 1, "b": 2}, 0]').digest()
    assert reference_seed("heldout", Case(seed=7, options={"b": 2, "a": 1}), 0) == expected[:16]
    assert reference_seed("train", Case(seed=7, options={}), 0) == reference_seed("train", Case(seed=7), 0)
    seeds = {
        reference_seed(split, Case(seed=seed), time)
        for split in ("train", "validation", "heldout")
        for seed in range(12)
        for time in range(3)
    }
    assert len(seeds) == 3 * 12 * 3


@given(st.lists(st.integers(0, 4)))
def test_an_occurrence_counts_the_same_case_earlier_in_the_list(ids: list[int]) -> None:
    assert occurrences(ids) == tuple(ids[:place].count(case_id) for place, case_id in enumerate(ids))


def test_giving_a_job_back_is_nobodys_fault() -> None:
    assert decide(SETTINGS, "returned", failures=9, ran=True) == (0.0, False, False, False)


def test_a_lost_worker_makes_suspects_only_of_what_it_played() -> None:
    assert decide(SETTINGS, "worker_lost", failures=1, ran=True).alone
    waiting = decide(SETTINGS, "worker_lost", failures=1, ran=False)
    assert (waiting.alone, waiting.avoid, waiting.delay_s) == (False, False, 0.0)


@given(st.integers(1, 10_000))
def test_back_off_grows_and_stays_bounded(failures: int) -> None:
    assert SETTINGS.retry_base_s <= backoff_s(SETTINGS, failures) <= SETTINGS.retry_max_s
    assert backoff_s(SETTINGS, failures) <= backoff_s(SETTINGS, failures + 1)
