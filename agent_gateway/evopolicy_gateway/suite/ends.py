"""The exit code of a command that plays runs, and its reasons."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from evopolicy_common.records.suite_folder import Entry, Index
from evopolicy_common.terminal import say_lines
from evopolicy_gateway.run.plan import Plan

EXIT_CODES = {"error": 1, "cancelled": 5, "agent_failed": 4, "no_ok_submit": 3}
"""Exit codes of a command that plays runs, most severe first; 0 when every run completed."""
_AGENT_FAILED = {"agent_failed": "its agent failed", "silent": "its agent was silent for too long"}


def exit_code(runs: Sequence[Plan], index: Index) -> int:
    """The code of the most severe end, see `EXIT_CODES`. Prints why each incomplete run did not complete on stderr."""
    ends = [(run, index.runs.get(run.name)) for run in runs]
    say_lines((_why(run, entry) for run, entry in ends if _kind(entry) != "completed"), err=True)
    kinds = {_kind(entry) for _, entry in ends}
    return next((code for kind, code in EXIT_CODES.items() if kind in kinds), 0)


def _kind(entry: Entry | None) -> str:
    """A key of `EXIT_CODES`, or `completed`."""
    if entry is None:
        return "error"
    if entry.closed_reason in _AGENT_FAILED and entry.state != "cancelled":
        return "agent_failed"
    return entry.state if entry.state in EXIT_CODES or entry.state == "completed" else "error"


def _why(run: Plan, entry: Entry | None) -> str:
    if entry is None or entry.state == "pending":
        return f"{run.name}: it was not begun"
    reasons = {
        "agent_failed": _AGENT_FAILED.get(entry.closed_reason),
        "no_ok_submit": "the agent made no submit, or none had a working policy",
        "cancelled": "it was cancelled",
    }
    why = entry.error or reasons.get(_kind(entry), f"it was left {entry.state}")
    return f"{run.name}: {why}" + (f"; see {run.folder.root}" if entry.directory else "")


def next_step(runs: Path) -> str:
    """The suggested next command for the runs in that folder."""
    return f"next: evopolicy report {shlex.quote(str(runs))} --out report"
