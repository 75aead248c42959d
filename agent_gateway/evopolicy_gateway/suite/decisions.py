"""Decisions for each run of a sweep at its start: rules without I/O, reported before they are carried out.

- A finished run is kept. One that ended in an error, ours or its provider's, or was cancelled, is restarted as a new
  attempt.
- A run that the cluster has closed, or whose agent has ended, is only finished. An open run resumes in its agent's
  session; without a session it is restarted as a new attempt, and its files are kept aside.
- If the file's settings differ from those that a run was played with, the operator decides.
- Runs without common hidden cases are preferred for playing side by side. Runs with common ones wait for each other,
  because the agent of one may not share a machine with hidden episodes of the other.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Literal

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError
from evopolicy_common.records.suite_folder import FINISHED, SweepRun
from evopolicy_gateway.run.plan import Plan

Kind = Literal["keep", "new", "resume", "finish", "restart"]
Changed = Literal["refuse", "keep", "rerun"]

_SHOWN = 4
_WORDS: dict[Kind, str] = {
    "keep": "kept",
    "new": "new",
    "resume": "resumed in its session",
    "finish": "only finished",
    "restart": "restarted as a new attempt",
}


class Facts(msgspec.Struct, frozen=True, kw_only=True):
    """The known facts about a run."""

    entry: SweepRun | None = None
    status: str | None = None
    """The status in its `run.json`."""
    opened: bool = False
    """Whether its folder holds an unfinished run."""
    intended: bool = False
    """Whether its folder holds no run but the request to open one with the run's settings, which may have been
    served."""
    phase: str | None = None
    """That run's phase at the cluster; None when the cluster does not know it: another one, or one on a backup from
    before the run, which opens it again."""
    closing: bool = False
    """Whether that run's agent has ended and only the closing is left."""
    has_session: bool = False
    """Whether its agent can resume its session."""


class Decision(msgspec.Struct, frozen=True, kw_only=True):
    run: Plan
    kind: Kind
    attempt: int
    why: str = ""
    changed: bool = False
    """Whether the file's settings differ from those that it was played with."""


def decide(run: Plan, facts: Facts, changed: Changed = "refuse") -> Decision:
    entry = facts.entry
    before = 1 if entry is None else entry.attempt
    exists = facts.status is not None or facts.opened or (entry is not None and entry.state != "pending")
    differs = entry is not None and exists and entry.digest != run.digest
    how = "" if entry is None or not differs else _changed(entry.settings, run.defining)

    def decided(kind: Kind, why: str = "", *, differs: bool = False) -> Decision:
        attempt = before + (kind == "restart")
        return Decision(run=run, kind=kind, attempt=attempt, why=why, changed=differs)

    if differs and changed != "keep":
        return decided("restart", how, differs=True)
    settled = entry is not None and entry.state in FINISHED
    elsewhere = entry is not None and not entry.directory
    if facts.status in FINISHED or (settled and (elsewhere or not facts.opened)):
        return decided("keep", how, differs=differs)
    if facts.status is not None:
        return decided("restart", (entry.error if entry is not None else None) or "it ended in an error")
    if not facts.opened:
        if facts.intended:
            return decided("resume", "its command ended while it was opened")
        if entry is not None and entry.state in ("running", "error", "cancelled"):
            return decided("restart", "its folder is gone")
        return decided("new")
    if facts.closing or facts.phase not in ("open", None):
        return decided("finish")
    if facts.has_session:
        return decided("resume")
    return decided("restart", "its agent keeps no session that could be continued")


def side_by_side(waiting: Sequence[Decision], under_way: Iterable[Plan]) -> list[Decision]:
    """Orders waiting runs for starting: first those that share hidden cases with the fewest runs under way.

    Otherwise their order is kept. `under_way`: runs whose agent is alive or whose hidden cases are being played.
    """
    shared = Counter(_hidden_cases(run) for run in under_way)
    return sorted(waiting, key=lambda one: shared[_hidden_cases(one.run)])


def _hidden_cases(run: Plan) -> str:
    """A key that is equal for runs with common hidden cases."""
    return run.settings.env if run.settings.hidden_cases == "shared" else run.name


def _changed(before: Mapping[str, object], now: Mapping[str, object]) -> str:
    text = "the file has other settings for it now"
    if not before:
        return text
    old, new = dict(_leaves("", before)), dict(_leaves("", msgspec.to_builtins(now)))
    names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    changes = [f"{name} is {_shown(new.get(name))}, was {_shown(old.get(name))}" for name in names]
    return f"{text}: {_first(changes)}"


def _first(texts: Sequence[str]) -> str:
    more = len(texts) - _SHOWN
    return ", ".join(texts[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def _leaves(path: str, value: object) -> Iterator[tuple[str, object]]:
    """Settings by their dotted names in the suite's file."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _leaves(name if path in ("", "settings") else f"{path}.{name}", inner)
    else:
        yield path, value


def _shown(value: object) -> str:
    return "not set" if value is None else msgspec.json.encode(value).decode()


def check_changes(decisions: Sequence[Decision], changed: Changed) -> None:
    """Raises ConfigError that names the runs with changed settings, unless the operator has decided about them."""
    names = [one.run.name for one in decisions if one.changed]
    if names and changed == "refuse":
        raise ConfigError(
            f"the suite's file has changed since {_first(names)} {'was' if len(names) == 1 else 'were'} played:"
            " give --changed keep to keep them, or --changed rerun to play them again"
        )


def feedback_bytes(decisions: Sequence[Decision]) -> int:
    """Upper bound for the feedback of the runs to be played, bytes, without videos."""
    played = [one.run.settings for one in decisions if one.kind in ("new", "resume", "restart")]
    budgets = [(one.env, one.budget or catalogue.suite_of(one.env).budget) for one in played]
    return sum(catalogue.entry(env).feedback_bytes(budget) for env, budget in budgets)


def lines(decisions: Sequence[Decision], left_alone: Sequence[str]) -> list[str]:
    """The decisions as lines: counts first, then each run that is neither new nor simply kept."""
    counts = Counter(one.kind for one in decisions)
    parts = [f"{counts[kind]} {word}" for kind, word in _WORDS.items() if counts[kind]]
    lines = [f"{len(decisions)} runs: {', '.join(parts)}"]
    for one in decisions:
        if one.kind in ("resume", "finish", "restart") or one.why:
            lines.append(f"  {one.run.name}: {_WORDS[one.kind]}" + (f" ({one.why})" if one.why else ""))
    lines += [f"  {name}: no longer in the file, left alone" for name in left_alone]
    return lines
