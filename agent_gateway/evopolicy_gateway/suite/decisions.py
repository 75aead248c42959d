"""What is done with each run of a sweep at a start: rules without I/O, said before anything is done.

- A finished run is kept. One that ended in an error, ours or its provider's, is played again as a new attempt.
- A run that the cluster has closed is only finished. One still open goes on in its agent's session; without a session it
  is begun again as a new attempt, and what there is of it is kept aside.
- Where the file now wants other settings than a run was played with, the operator decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_gateway.suite.suite_file import SuiteRun
from evopolicy_gateway.suite.suite_index import FINISHED, Entry

Kind = Literal["keep", "new", "resume", "finish", "restart"]
Changed = Literal["refuse", "keep", "rerun"]

_WORDS: dict[Kind, str] = {
    "keep": "kept",
    "new": "new",
    "resume": "goes on in its session",
    "finish": "only finished",
    "restart": "begun again as a new attempt",
}


class Found(msgspec.Struct, frozen=True, kw_only=True):
    """What there is of a run."""

    entry: Entry | None = None
    """In the index."""
    status: str | None = None
    """In its `run.json`."""
    opened: bool = False
    """Its folder holds a run that is not finished."""
    phase: str | None = None
    """Of that run at the cluster; None when the cluster does not know it."""
    has_session: bool = False
    """Its agent can go on where it was."""


class Decision(msgspec.Struct, frozen=True, kw_only=True):
    """For one run."""

    run: SuiteRun
    kind: Kind
    attempt: int
    why: str = ""

    @property
    def changed(self) -> bool:
        return self.why == CHANGED


CHANGED = "the file has other settings for it now"


def decide(run: SuiteRun, found: Found, changed: Changed = "refuse") -> Decision:
    """What becomes of a run."""
    entry = found.entry
    attempt = 1 if entry is None else entry.attempt
    exists = found.status is not None or found.opened or (entry is not None and entry.state != "pending")
    differs = entry is not None and exists and entry.digest != run.digest
    if differs and changed != "keep":
        return Decision(run=run, kind="restart", attempt=attempt + 1, why=CHANGED)
    if found.status in FINISHED or (entry is not None and entry.state in FINISHED and not found.opened):
        return Decision(run=run, kind="keep", attempt=attempt, why=CHANGED if differs else "")
    if found.status is not None:
        why = (entry.error if entry is not None else None) or "it ended in an error"
        return Decision(run=run, kind="restart", attempt=attempt + 1, why=why)
    if not found.opened:
        if entry is not None and entry.state in ("running", "error"):
            return Decision(run=run, kind="restart", attempt=attempt + 1, why="its folder is gone")
        return Decision(run=run, kind="new", attempt=attempt)
    if found.phase is None:
        why = "the cluster does not know it any more"
        return Decision(run=run, kind="restart", attempt=attempt + 1, why=why)
    if found.phase != "open":
        return Decision(run=run, kind="finish", attempt=attempt)
    if found.has_session:
        return Decision(run=run, kind="resume", attempt=attempt)
    why = "its agent keeps no session that could be continued"
    return Decision(run=run, kind="restart", attempt=attempt + 1, why=why)


def check_changes(decisions: Sequence[Decision], changed: Changed) -> None:
    """ConfigError naming the runs whose settings have changed, unless the operator has said what to do."""
    names = [one.run.name for one in decisions if one.changed]
    if names and changed == "refuse":
        shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
        raise ConfigError(
            f"the suite's file has changed since {shown} {'was' if len(names) == 1 else 'were'} played:"
            " say --changed keep to leave them as they are, or --changed rerun to play them again"
        )


def told(decisions: Sequence[Decision], left_alone: Sequence[str]) -> list[str]:
    """What will be done, in lines: counts first, then each run that is neither new nor simply kept."""
    counts = {kind: sum(one.kind == kind for one in decisions) for kind in _WORDS}
    parts = [f"{n} {_WORDS[kind]}" for kind, n in counts.items() if n]
    lines = [f"{len(decisions)} runs: {', '.join(parts)}"]
    for one in decisions:
        if one.kind in ("resume", "finish", "restart") or one.why:
            lines.append(f"  {one.run.name}: {_WORDS[one.kind]}" + (f" ({one.why})" if one.why else ""))
    lines += [f"  {name}: no longer in the file, left alone" for name in left_alone]
    return lines
