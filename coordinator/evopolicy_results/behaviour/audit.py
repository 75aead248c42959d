"""Tokens and wall time of each agent (paper, appendix: token and cost accounting). No score depends on them."""

from __future__ import annotations

from collections.abc import Iterable
from statistics import fmean

import msgspec

from evopolicy_results.reading.environments import by_name, grouped
from evopolicy_results.reading.records import PastRun, by_cell

PHASES = ("agent_s", "queue_s", "rollout_s", "feedback_s", "finalise_s")
"""Phases of a run's wall time, as fields of `Timing`."""


COUNTS_DIFFER = 0.05
"""Share of the relay's count above which the agent's own is shown as another."""


class TokenUse(msgspec.Struct, frozen=True, kw_only=True):
    """Mean token use of one entry on one environment, in millions of tokens, over the runs that record it."""

    entry: str
    env: str
    n_runs: int
    """Runs whose agent records its tokens; with 0 the table shows a dash."""
    input_noncached: float | None
    cache: float | None
    """Cache read plus cache creation."""
    output: float | None
    """Including reasoning."""
    cost: float | None
    """US dollars per run; None when any of the runs has no price."""
    metering: str = ""
    """The counter: `relay`, `agent`, or both in different runs; empty where nothing counted."""
    hosted_tools: str = ""
    """Kinds of tools of the provider that requests offered to the model."""
    differing: int = 0
    """Runs in which the agent's own count differs from the relay's by more than `COUNTS_DIFFER`."""


def mean_phases(runs: Iterable[PastRun]) -> dict[str, dict[str, float]]:
    """By entry, the mean wall time of a run by phase, in seconds; without entries that record none."""
    by_entry = grouped((run for run in runs if not run.is_published), lambda run: run.entry)
    return {
        entry: {phase: fmean(getattr(run.record.timing, phase) for run in several) for phase in PHASES}
        for entry, several in sorted(by_entry.items(), key=lambda item: by_name(item[0]))
    }


def token_use(runs: Iterable[PastRun]) -> list[TokenUse]:
    """Every (environment, entry) that was played, environments in catalogue order, entries by name."""
    out: list[TokenUse] = []
    for (env, entry), several in by_cell(runs).items():
        agents = [run.record.agent for run in several]
        counts = [agent.tokens for agent in agents if agent.tokens is not None]
        uses = [(agent.model_use, agent.tokens) for agent in agents]
        known = [(use, use.difference(tokens) or 0.0) for use, tokens in uses if use is not None]
        costs = [tokens.cost for tokens in counts if tokens.cost is not None]
        out.append(
            TokenUse(
                entry=entry,
                env=env,
                n_runs=len(counts),
                input_noncached=fmean(t.input_noncached for t in counts) / 1e6 if counts else None,
                cache=fmean(t.cache_read + t.cache_creation for t in counts) / 1e6 if counts else None,
                output=fmean(t.output for t in counts) / 1e6 if counts else None,
                cost=fmean(costs) if counts and len(costs) == len(counts) else None,
                metering=", ".join(sorted({use.metering for use, _ in known})),
                hosted_tools=", ".join(sorted({kind for use, _ in known for kind in use.hosted_tools})),
                differing=sum(apart > COUNTS_DIFFER for _, apart in known),
            )
        )
    return out
