"""The expected results, computed from the scenario alone: no core, no faults, no time.

A policy's name here states its behaviour, so an episode's result follows from its case, its policy, its policy seed and
the metadata that the policy receives:
  good-N       plays
  raises-N     fails in every episode at `act`, which is a result
  none-N       yields no Policy, in any episode
  late-N       yields no Policy in the episodes after request index 0, which is those episodes' failure
"""

from __future__ import annotations

import hashlib
import hmac
import zlib
from dataclasses import dataclass
from typing import Any

from evopolicy_common.messages.episode import FailureCategory

VALIDATION_SEEDS = range(10_000, 20_000)
HELDOUT_SEEDS = range(20_000, 30_000)


@dataclass(frozen=True)
class PlannedSubmit:
    ids: tuple[int, ...]
    bundle: str


@dataclass(frozen=True)
class PlannedRun:
    """A run as its gateway will play it, with its cases."""

    name: str
    env: str
    budget: int
    n_validation: int
    n_heldout: int
    scope: str
    submits: tuple[PlannedSubmit, ...]
    cancel_at: float | None = None
    """When an operator cancels it, seconds after the start; None for never."""
    kin: str = ""
    """Runs with equal `kin` have the same hidden cases; empty: cases of its own."""
    hostile: bool = False
    """Its gateway lies; it may end in any way, but it ends."""

    def related(self, other: PlannedRun) -> bool:
        """Whether they share a hidden case."""
        if self.env != other.env:
            return False
        splits = ("validation", "heldout")
        return any(not set(self.cases(split)).isdisjoint(other.cases(split)) for split in splits)

    @property
    def secret(self) -> bytes:
        return hashlib.sha256(self.name.encode()).digest()

    def cases(self, split: str) -> list[int]:
        """The seeds of a split's cases."""
        salt = zlib.crc32(self.name.encode()) % 50
        if split != "train" and self.kin:
            salt = zlib.crc32(self.kin.encode()) % 50
        if split == "train":
            return [salt + index for index in range(64)]
        if split == "validation":
            return [VALIDATION_SEEDS[salt + index] for index in range(self.n_validation)]
        return [HELDOUT_SEEDS[salt + index] for index in range(self.n_heldout)]

    def admitted(self) -> list[PlannedSubmit]:
        """The submits that fit the budget and the case ids, in order; the others are refused."""
        left, taken = self.budget, []
        for submit in self.submits:
            if 1 <= len(submit.ids) <= left and all(0 <= case_id < 64 for case_id in submit.ids):
                taken.append(submit)
                left -= len(submit.ids)
        return taken


@dataclass(frozen=True)
class Expected:
    """The stored outcome of one episode."""

    episode_return: float
    failure: FailureCategory | None


@dataclass(frozen=True)
class ExpectedSubmit:
    status: str
    episodes: tuple[Expected, ...]
    mean: float | None
    val_mean: float | None


@dataclass(frozen=True)
class ExpectedRun:
    submits: tuple[ExpectedSubmit, ...]
    status: str
    best: int | None
    heldout: tuple[float, ...]
    random: tuple[float, ...]


def failure_of(bundle: str | None, index: int) -> FailureCategory | None:
    """Failure of the policy in the episode at `index`; None for none."""
    kind = "" if bundle is None else bundle.split("-")[0]
    if kind == "none" or (kind == "late" and index > 0):
        return "init_error"
    return "act_error" if kind == "raises" else None


def return_of(
    case_seed: int, bundle: str | None, policy_seed: bytes, episode_index: int, meta: dict[str, Any]
) -> float:
    """An episode's return: depends on everything that an episode may depend on, and on nothing else."""
    known = sorted(
        (name, value) for name, value in meta.items() if name not in ("obs_storage", "max_episode_steps")
    )
    text = repr((case_seed, bundle, policy_seed, episode_index, known))
    return zlib.crc32(text.encode()) % 16 / 4.0


def _seed(run: PlannedRun, submit_index: int, split: str, case_id: int, occurrence: int) -> bytes:
    text = f"{submit_index}|{split}|{case_id}|{occurrence}"
    return hmac.new(run.secret, text.encode(), "sha256").digest()[:16]


def _reference_seed(case_seed: int) -> bytes:
    """Random actions follow from split and case alone, in every run."""
    text = f'["heldout", {case_seed}, null, 0]'
    return hashlib.sha256(b"evopolicy random reference\0" + text.encode()).digest()[:16]


def _played(
    run: PlannedRun,
    split: str,
    ids: list[int],
    bundle: str | None,
    submit_index: int,
    modulo: int,
    meta: dict[str, Any],
) -> tuple[Expected, ...]:
    seeds = run.cases("heldout" if bundle is None else split)
    played = []
    for index, case_id in enumerate(ids):
        if bundle is None:
            seed = _reference_seed(seeds[case_id])
        else:
            seed = _seed(run, submit_index, split, case_id, ids[:index].count(case_id))
        value = return_of(seeds[case_id], bundle, seed, index % modulo, meta)
        played.append(Expected(value, failure_of(bundle, index)))
    return tuple(played)


def _mean(episodes: tuple[Expected, ...]) -> float:
    return sum(each.episode_return for each in episodes) / len(episodes)


def expect(run: PlannedRun) -> ExpectedRun:
    """The result of a run that is not cancelled."""
    submits: list[ExpectedSubmit] = []
    heldout_of: dict[int, tuple[float, ...]] = {}
    left = run.budget
    for index, submit in enumerate(run.admitted()):
        n = len(submit.ids)
        left -= n
        meta = {
            "env": run.env,
            "submit_index": index,
            "n_episodes_this_submit": n,
            "remaining_budget_after": left,
        }
        episodes = _played(run, "train", list(submit.ids), submit.bundle, index, n, meta)
        if failure_of(submit.bundle, 0) == "init_error":
            submits.append(ExpectedSubmit("init_error", episodes, None, None))
            continue
        hidden = _played(run, "validation", list(range(run.n_validation)), submit.bundle, index, n, meta)
        heldout = _played(run, "heldout", list(range(run.n_heldout)), submit.bundle, index, n, meta)
        heldout_of[index] = tuple(each.episode_return for each in heldout)
        submits.append(ExpectedSubmit("ok", episodes, _mean(episodes), _mean(hidden)))
    ok = {index: each.val_mean for index, each in enumerate(submits) if each.val_mean is not None}
    best = max(ok, key=lambda index: (ok[index], index), default=None)
    random = _played(run, "random", list(range(run.n_heldout)), None, -1, run.n_heldout, {"env": run.env})
    return ExpectedRun(
        submits=tuple(submits),
        status="no_ok_submit" if best is None else "completed",
        best=best,
        heldout=() if best is None else heldout_of[best],
        random=tuple(each.episode_return for each in random),
    )
