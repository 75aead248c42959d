"""`feedback/submit_NNN/summary.json`: what an agent is told of one submit, field by field and in this order.

The gateway writes it last in a submit's folder and answers `POST /submit` with the same bytes; the analysis reads it.
Nothing in it is hidden: no seed, no hidden score. A submit that is not `ok` has every array and aggregate null, while
`env_instances`, `n_episodes` and `remaining_budget` still tell what was asked for and charged. Earlier versions wrote
`schema_version` 1, and null for `env_instances` in its place; their summaries are read too.
"""

from __future__ import annotations

from datetime import UTC, datetime

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError
from evopolicy_common.messages.gateway import SubmitStatus
from evopolicy_common.records.code_metrics import PUBLISHED_SCHEMA

SCHEMA_VERSION = PUBLISHED_SCHEMA
_READ = (SCHEMA_VERSION, 1)


class Summary(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One submit's summary. Fields with defaults may be left out."""

    schema_version: str | int
    submit_index: int
    """Counts accepted submits from 0."""
    env: str
    """Suite id, such as `gym/acrobot`."""
    status: SubmitStatus
    n_episodes: int
    """Episodes charged; 0 when `cancelled`."""
    first_global_episode: int | None
    """Number of its first episode, counting attempted episodes through the run from 0; null when not ok."""
    env_instances: tuple[int, ...] | None
    """Train ids in request order, repeats kept."""
    remaining_budget: int
    """Episodes left after this submit."""
    submit_started_at: str
    """When it was accepted: UTC, ISO 8601 as `utc_text` writes it."""
    submit_completed_at: str
    wall_time_seconds: float
    returns: tuple[float, ...] | None
    """Return of each episode, request order."""
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
    """Mean over episodes of each component's sum; left out when the environment reports none."""
    reward_components_per_episode: tuple[dict[str, float], ...] | None = None
    """Each episode's sums, request order; left out likewise."""
    successes: tuple[bool | None, ...] | None = None
    """Whether each episode solved the task, by the environment's own word; left out where it tells none."""
    policy_failures: int | None = None
    """How many episodes the policy failed in; left out when not ok, and in files of earlier versions."""
    warning: str | None = None
    """How it failed, in words for the agent; left out when it did not."""


_decoder = msgspec.json.Decoder(Summary)


def decode_summary(data: bytes) -> Summary:
    """The summary in `data`, unknown fields skipped; ProtocolError when it is none that this version reads."""
    try:
        summary = _decoder.decode(data)
    except DECODE_ERRORS as error:
        raise ProtocolError(f"not a submit summary: {error}") from error
    if summary.schema_version not in _READ:
        raise ProtocolError(
            f"summary has schema_version {summary.schema_version}, this version reads {SCHEMA_VERSION}: update evopolicy"
        )
    return summary


def utc_text(unix_s: float) -> str:
    """`unix_s` (seconds since 1970, UTC) as `2026-01-31T12:00:00.123456Z`; always microseconds, so texts sort."""
    return datetime.fromtimestamp(unix_s, UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
