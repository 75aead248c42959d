"""`feedback/submit_NNN/summary.json`: the result of one submit for its agent, field by field and in this order.

The gateway writes it last in a submit's folder and answers `POST /submit` with the same bytes; the analysis reads it.
It contains nothing hidden: no seed, no hidden score. In the summary of a submit that is not `ok`, all arrays and
aggregates are null, while `env_instances`, `n_episodes` and `remaining_budget` still give the request and the charge.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Literal

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError, raised_as
from evopolicy_common.messages.bounds import check_plausible
from evopolicy_common.messages.gateway import SubmitStatus
from evopolicy_common.records.code_metrics import PUBLISHED_SCHEMA

SCHEMA_VERSION = PUBLISHED_SCHEMA


class Summary(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One submit's summary. Fields with defaults may be missing."""

    schema_version: str | int
    submit_index: int
    """Index among the accepted submits, from 0."""
    env: str
    """Suite id, such as `gym/acrobot`."""
    status: SubmitStatus | Literal["budget_invalid", "invalid_env_instance"]
    """The last two: only in the published software."""
    n_episodes: int
    """Episodes charged; 0 when `cancelled`."""
    first_global_episode: int | None
    """Number of its first episode in the run, from 0; null when not ok."""
    env_instances: tuple[int | bool, ...] | None
    """Train ids in request order, with repeats. The published software keeps `true` and `false`."""
    remaining_budget: int
    """Episodes left after this submit."""
    submit_started_at: str
    """Time of acceptance: UTC, ISO 8601 as `utc_text` writes it."""
    submit_completed_at: str
    wall_time_seconds: float
    returns: tuple[float, ...] | None
    """Return of each episode, in request order."""
    mean_return: float | None
    std_return: float | None
    """Population standard deviation (divides by n)."""
    min_return: float | None
    max_return: float | None
    episode_lengths: tuple[int, ...] | None
    """Steps of each episode."""
    mean_episode_length: float | None
    timeouts: tuple[int, ...] | None
    """Local (request) indices of the episodes whose policy hit a time limit."""
    errors: tuple[int, ...] | None
    """Local indices of the episodes whose policy failed, time limits included."""
    reward_components_mean: dict[str, float] | None = None
    """Mean over episodes of each component's sum; missing without components."""
    reward_components_per_episode: tuple[dict[str, float], ...] | None = None
    """Each episode's sums, in request order."""
    successes: tuple[bool | None, ...] | None = None
    """Whether each episode solved the task; missing if the environment does not report it."""
    policy_failures: int | None = None
    """Episodes in which the policy failed; missing when not ok."""
    warning: str | None = None
    """How the policy failed; missing if it did not."""

    @property
    def brief(self) -> Summary:
        """Without its long fields by episode."""
        return msgspec.structs.replace(self, **dict.fromkeys(_BY_EPISODE))


_BY_EPISODE = ("env_instances", "returns", "episode_lengths", "reward_components_per_episode", "successes")

_decoder = msgspec.json.Decoder(Summary)


def decode_summary(data: bytes) -> Summary:
    """The summary in `data`; unknown fields are skipped. Raises ProtocolError when this version cannot read it."""
    with raised_as(ProtocolError, "not a submit summary", *DECODE_ERRORS, ValueError):
        summary = check_plausible(_decoder.decode(data))
    if summary.schema_version != SCHEMA_VERSION:
        raise ProtocolError(
            f"summary has schema_version {summary.schema_version}, this version reads {SCHEMA_VERSION}: use"
            " the version of evopolicy that wrote it"
        )
    return summary


def utc_text(unix_s: float) -> str:
    """`unix_s` (seconds since 1970, UTC) as `2026-01-31T12:00:00.123456Z`; always microseconds, so that texts sort."""
    return datetime.fromtimestamp(unix_s, UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
