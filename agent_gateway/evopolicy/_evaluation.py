"""The result of playing a policy on cases."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from evopolicy._records import Records, bars
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.records.aggregates import mean
from evopolicy_common.records.episodes.trajectory import decode
from evopolicy_gateway.submits.formatting import failure_text


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One episode with its trajectory."""

    case: int
    """Train id."""
    episode_return: float | None
    """Sum of rewards; None when nothing was played because the first case showed that the code yields no Policy."""
    length: int
    """Steps."""
    terminated: bool
    truncated: bool
    failure: str | None
    """Category, step and message of the policy's failure; random actions played from that step on. None: no failure."""
    observations: Any
    """Observation before each step, in dicts and tuples as in the space. Each leaf is an array of shape (length, …) in
    the recorded dtype, or a list of strings. None when nothing was played.
    """
    actions: Any
    """The policy's returned actions: an array of shape (length, …), or a list when actions differ in form."""
    rewards: NDArray[np.float64]
    """float64, shape (length,)."""
    infos: list[dict[str, Any]]
    """The environment's info dict of each step."""
    stdout: str
    """Printed by the policy; bytes that are not UTF-8 are replaced."""
    stderr: str


class EvaluationRecord(msgspec.Struct, frozen=True, kw_only=True):
    """An episode without its trajectory, for data frames."""

    case: int
    episode_return: float | None
    length: int
    terminated: bool
    truncated: bool
    failure: str | None


class Evaluation(Sequence[Episode]):
    """A sequence of episodes in the order of the cases."""

    def __init__(self, env: str, episodes: Sequence[Episode]) -> None:
        self.env = env
        self.episodes = tuple(episodes)

    def __getitem__(self, index: Any) -> Any:
        return self.episodes[index]

    def __len__(self) -> int:
        return len(self.episodes)

    @property
    def returns(self) -> NDArray[np.float64]:
        """float64, shape (episodes,); NaN for episodes that were not played."""
        returns = [one.episode_return for one in self.episodes]
        return np.array([math.nan if value is None else value for value in returns])

    @property
    def lengths(self) -> NDArray[np.int64]:
        """Steps, int64, shape (episodes,)."""
        return np.array([one.length for one in self.episodes], dtype=np.int64)

    @property
    def mean_return(self) -> float | None:
        """Mean over the cases in which the policy did not fail; None when there are none."""
        returns = [one.episode_return for one in self.episodes if one.failure is None]
        known = [value for value in returns if value is not None]
        return mean(known) if known else None

    @property
    def records(self) -> Records[EvaluationRecord]:
        """The episodes without their trajectories."""
        made = [msgspec.convert(one, EvaluationRecord, from_attributes=True) for one in self.episodes]
        return Records(EvaluationRecord, made)

    def to_pandas(self) -> Any:
        """`records` as a pandas.DataFrame. Raises ModuleNotFoundError when pandas is not installed."""
        return self.records.to_pandas()

    def to_polars(self) -> Any:
        """`records` as a polars.DataFrame. Raises ModuleNotFoundError when polars is not installed."""
        return self.records.to_polars()

    def __repr__(self) -> str:
        mean = "none" if self.mean_return is None else f"{self.mean_return:.4g}"
        return f"<Evaluation of {self.env}: {len(self)} episodes, mean return {mean}>"

    def _repr_html_(self) -> str:
        plot = bars([one.episode_return for one in self.episodes], "returns")
        return f"<p>{html.escape(repr(self))}</p>{plot}{self.records._table()}"


def episode_of(case: int, outcome: EpisodeOutcome, packed: bytes | None) -> Episode:
    """Combines an outcome with its trajectory. `packed`: the trajectory's bytes, None when there is none."""
    played = None if packed is None else decode(packed)
    return Episode(
        case=case,
        episode_return=outcome.episode_return if outcome.length else None,
        length=outcome.length,
        terminated=outcome.terminated,
        truncated=outcome.truncated,
        failure=failure_text(outcome.failure),
        observations=None if played is None else played.obs,
        actions=[] if played is None else played.actions,
        rewards=np.zeros(0) if played is None else played.rewards,
        infos=[] if played is None else played.infos,
        stdout=outcome.stdout.decode("utf-8", "replace"),
        stderr=outcome.stderr.decode("utf-8", "replace"),
    )
