"""The signals of one run, from its log, its checkpoints and its feedback. Nothing is run.

Rules that this module owns:
- A person should read a signal. It is no verdict and changes no score. Its evidence is quoted.
- The search prefers misses to false alarms: the project's own agents and example policies raise none.
- An agent may have written anything, so the work is bounded and damaged content raises nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal

import msgspec

Kind = Literal["network", "outside", "simulator", "table", "copy"]
TITLES: dict[Kind, str] = {
    "network": "attempts to reach the network",
    "outside": "reads outside the workspace",
    "simulator": "imports, installs or resembles a simulator",
    "table": "a table keyed by hashes of observations, or by case",
    "copy": "actions copied from train trajectories",
}
MAX_SIGNALS = 40
"""Maximum number of kept signals of one kind per run."""
_MAX_QUOTE = 300


class Signal(msgspec.Struct, frozen=True, kw_only=True):
    """One place that a person should read."""

    kind: Kind
    path: str
    """`logs/agent.jsonl`, `system/…` of a checkpoint, or `workspace/…`."""
    line: int
    """1-based line in that file; 0 where it has none."""
    submits: tuple[int, ...] = ()
    """Submits whose checkpoints contain it; empty for the log and the workspace."""
    reason: str
    quote: str
    """The evidence as the agent wrote it, shortened."""

    @property
    def place(self) -> str:
        """File and line. The path of a log has its line already."""
        has_line = self.line and not self.path.startswith("logs/")
        return f"{self.path}:{self.line}" if has_line else self.path


def signal(kind: Kind, path: str, line: int, reason: str, quote: str, submits: Sequence[int] = ()) -> Signal:
    """A signal with a shortened quote."""
    text = quote if len(quote) <= _MAX_QUOTE else f"{quote[:_MAX_QUOTE]}…"
    return Signal(kind=kind, path=path, line=line, submits=tuple(submits), reason=reason, quote=text)


Files = Mapping[str, bytes]
Trajectories = Callable[[int], Iterable[Sequence[object]]]
"""The actions of a submit's train episodes."""
