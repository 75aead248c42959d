"""Feedback as bytes: pure functions from results to file contents, deterministic to the byte.

`records.json_text` defines how values are written.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec

from evopolicy_common.messages.environment import ObservationForm
from evopolicy_common.messages.episode import NO_POLICY, TIME_LIMITS, PolicyFailure
from evopolicy_common.messages.gateway import EpisodeFeedback, SubmitDone
from evopolicy_common.records.aggregates import mean, std
from evopolicy_common.records.json_text import json_bytes, plain
from evopolicy_common.records.summary import SCHEMA_VERSION, Summary, utc_text

MAX_TEXT_BYTES = 64 << 10
"""Maximum size of each of stdout.txt, stderr.txt, error.txt and errors.txt."""


_VERDICTS = {
    "rollout_timeout": "the submit's wall-time limit was reached before all episodes were played",
    "cancelled": "the operator cancelled the run before all episodes were played; nothing is charged",
}
"""Messages of submits that are not ok without a failure of the policy, by status."""
_MAX_WARNED = 300
"""Characters of a policy's own message in a warning."""


def cut_text(data: bytes) -> bytes:
    """The first `MAX_TEXT_BYTES` of a stream."""
    return data[:MAX_TEXT_BYTES]


def failure_text(failure: PolicyFailure | None) -> str | None:
    """Category, step and message of a failure, for people; None for none."""
    if failure is None:
        return None
    at = "" if failure.step_index is None else f" at step {failure.step_index}"
    return f"{failure.category}{at}: {failure.message}"


def failure_line(failure: PolicyFailure, at: float) -> bytes:
    """A failure as a line of an episode's `error.txt`, cut to 64 KiB. `at`: Unix time, seconds."""
    more: dict[str, object] = {"step_index": failure.step_index}
    if failure.limit is not None:
        more |= {"limit": failure.limit, "used": failure.used}
    return _line(at, failure.category, failure.message, failure.traceback, more)


def verdict_line(status: str, failure: PolicyFailure | None, at: float, *, traceback: bool = True) -> bytes:
    """The line of `errors.txt` with the reason why a submit is not ok; its category is the submit's status.

    The failure's own category precedes the message when the two differ. `traceback`: False writes null for it, as
    published.
    """
    own, details = _VERDICTS.get(status, f"the submit ended with {status}"), ""
    if failure is not None:
        same = failure.category == status or failure.category in NO_POLICY
        own = failure.message if same else f"{failure.category}: {failure.message}"
        details = failure.traceback
    return _line(at, status, own, details if traceback else None, {})


def summary_bytes(
    env: str,
    submit_index: int,
    done: SubmitDone,
    scores: Sequence[EpisodeFeedback],
    observations: ObservationForm = "arrays",
    *,
    messages: bool = True,
    every_key: bool = False,
) -> bytes:
    """The bytes of `summary.json`. `scores` hold every episode of a played submit, in any order.

    `messages`: whether the warning quotes the policy's own messages. `every_key`: the parts of the reward are null and
    not left out, as published.

    Raises ValueError when an ok submit lacks an episode.
    """
    ok = done.status == "ok"
    # A submit of `end-submit` in which the policy failed is played to its end too.
    played = ok or (done.status == "rollout_timeout" and done.n_kept == done.n_episodes)
    ordered = sorted(scores, key=lambda score: score.index)
    if played and [score.index for score in ordered] != list(range(done.n_episodes)):
        raise ValueError(f"submit {submit_index} has {len(ordered)} of {done.n_episodes} episodes")
    returns = tuple(score.episode_return for score in ordered)
    components = tuple(score.reward_components for score in ordered)
    with_components = played and any(components)
    names = dict.fromkeys(name for parts in components for name in parts)
    means = {name: mean([parts.get(name, 0.0) for parts in components]) for name in names}
    lengths = tuple(score.length for score in ordered)
    solved = tuple(score.success for score in ordered)
    errors = _where(ordered, None)
    summary = Summary(
        schema_version=SCHEMA_VERSION,
        submit_index=submit_index,
        env=env,
        status=done.status,
        n_episodes=done.n_episodes,
        first_global_episode=done.first_global_episode if played else None,
        env_instances=done.env_instances,
        remaining_budget=done.remaining_budget,
        submit_started_at=utc_text(done.started_at),
        submit_completed_at=utc_text(done.completed_at),
        wall_time_seconds=round(max(0.0, done.completed_at - done.started_at), 6),
        returns=returns if played else None,
        mean_return=mean(returns) if ok else None,
        std_return=std(returns) if ok else None,
        min_return=min(returns) if played else None,
        max_return=max(returns) if played else None,
        episode_lengths=lengths if played else None,
        mean_episode_length=mean(lengths) if played else None,
        timeouts=_where(ordered, TIME_LIMITS) if played else None,
        errors=errors if played else None,
        reward_components_mean=means if with_components else None,
        reward_components_per_episode=components if with_components else None,
        successes=solved if played and None not in solved and solved else None,
        policy_failures=len(errors) if played else None,
        warning=_warning(ordered, observations, ends=not ok, messages=messages) if played else None,
    )
    fields = plain(msgspec.to_builtins(summary))
    if every_key:
        fields |= dict.fromkeys(("reward_components_mean", "reward_components_per_episode"))
    return msgspec.json.format(msgspec.json.encode(fields), indent=2) + b"\n"


def _warning(
    scores: Sequence[EpisodeFeedback], observations: ObservationForm, *, ends: bool, messages: bool
) -> str | None:
    """The warning about policy failures in a played submit. `ends`: such an episode ended."""
    failures = [score.failure for score in scores if score.failure is not None]
    if not failures:
        return None
    first, n = failures[0], len(scores)
    where = "before the first step" if first.step_index is None else f"at step {first.step_index}"
    which = f"ALL {n} episodes" if len(failures) == n else f"{len(failures)} of {n} episodes"
    message = f": {first.message[:_MAX_WARNED]}" if messages else ""
    text = f"the policy failed in {which} (first {where}, {first.category}{message})."
    if ends:
        text += " These episodes ended there, `errors` lists them, and the submit has no mean return."
    elif len(failures) == n:
        text += " Random actions played the rest, so these returns say nothing about your policy."
    else:
        text += " Random actions played the rest of these episodes, which `errors` lists."
    if observations == "arrays" and len(failures) == n and first.category == "act_error":
        text += " Observations arrive as numpy arrays in this run, not as nested lists."
    return text + (" Each error.txt has the traceback." if messages else "")


def _where(scores: Sequence[EpisodeFeedback], categories: frozenset[str] | None) -> tuple[int, ...]:
    """Request indices of the episodes that failed in one of `categories` (None: in any)."""
    return tuple(
        score.index
        for score in scores
        if score.failure is not None and (categories is None or score.failure.category in categories)
    )


def _line(at: float, category: str, message: str, traceback: str | None, more: dict[str, object]) -> bytes:
    """A line of JSON; to fit 64 KiB its traceback (from the start) and then its message are cut."""
    line: dict[str, Any] = {"schema_version": SCHEMA_VERSION, "timestamp": utc_text(at), "category": category}
    line |= {"message": message, "traceback": traceback} | more
    for field in ("traceback", "message"):
        text = line[field] or ""
        keep = len(text)
        while keep and len(json_bytes(line)) >= MAX_TEXT_BYTES:
            keep = keep * 3 // 4
            end = f"[cut] {text[len(text) - keep :]}"
            line[field] = end if field == "traceback" else f"{text[:keep]} [cut]"
    return json_bytes(line) + b"\n"
