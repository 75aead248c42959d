"""Audit signals and token accounting of each run (paper, appendix: audit signals, token and cost accounting).

These are diagnostics: no score depends on them. Runs of the published software record only some of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from statistics import fmean

import msgspec

from evopolicy_results.behaviour.edits import classify
from evopolicy_results.reading.environments import by_name, grouped
from evopolicy_results.reading.records import Run, by_cell

PHASES = ("agent_s", "queue_s", "rollout_s", "feedback_s", "finalise_s")
"""Phases of a run's wall time, as fields of `Timing`."""


class AuditSignals(msgspec.Struct, frozen=True, kw_only=True):
    """What follows from one run's submits and counts; its record has the rest."""

    run: Run
    not_ok: int
    """Accepted submits that are not ok."""
    invalid_rate: float | None
    """Invalid-transition rate: accepted submits that are not ok, of all accepted; None without any."""
    repaired_rate: float | None
    """Invalid-action rate: share of train steps whose action was repaired; None if the run has no record of it."""
    episodes_per_submit: float | None
    """Mean over accepted submits."""
    failed_episodes: int
    """Train episodes in which the policy failed."""
    score_drops: int
    """Score-bearing submits with a validation mean below that of the previous one."""
    complexity_growth: float | None
    """AST nodes of the selected source bundle divided by those of the first score-bearing one."""


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
    """The counter: `relay`, `agent`, or both in different runs; empty in files of earlier versions."""
    hosted_tools: str = ""
    """Kinds of tools of the provider that requests offered to the model."""
    differing: int = 0
    """Runs in which the agent's own count differs from the relay's by more than `COUNTS_DIFFER`."""


def audit_signals(run: Run) -> AuditSignals:
    """One run's signals."""
    accepted, selected = run.submits, run.selected
    not_ok = sum(submit.status != "ok" for submit in accepted)
    nodes = [each.source.features.nodes for each in (*run.scored[:1], selected) if each and each.source]
    return AuditSignals(
        run=run,
        not_ok=not_ok,
        invalid_rate=not_ok / len(accepted) if accepted else None,
        repaired_rate=_repaired_rate(run.record.outcome.auxiliary.get("transitions")),
        episodes_per_submit=fmean(submit.n_episodes for submit in accepted) if accepted else None,
        failed_episodes=sum(submit.n_failed_episodes for submit in accepted),
        score_drops=sum(transition.val_drop for transition in classify(accepted)),
        complexity_growth=nodes[1] / nodes[0] if len(nodes) == 2 and nodes[0] else None,
    )


def _repaired_rate(transitions: object) -> float | None:
    counts = transitions if isinstance(transitions, dict) else {}
    steps, invalid = counts.get("steps"), counts.get("action_invalid")
    if not isinstance(steps, int) or not isinstance(invalid, int) or not 0 <= invalid <= steps or not steps:
        return None
    return invalid / steps


def mean_phases(runs: Iterable[Run]) -> dict[str, dict[str, float]]:
    """By entry, the mean wall time of a run by phase, in seconds; without entries that record none."""
    by_entry = grouped((run for run in runs if not run.is_published), lambda run: run.entry)
    return {
        entry: {
            phase: fmean(getattr(run.record.timing, phase) for run in by_entry[entry]) for phase in PHASES
        }
        for entry in sorted(by_entry, key=by_name)
    }


def token_use(runs: Iterable[Run]) -> list[TokenUse]:
    """Every (environment, entry) that was played, environments in catalogue order, entries by name."""
    return [_token_use(env, entry, several) for (env, entry), several in by_cell(runs).items()]


def _token_use(env: str, entry: str, runs: list[Run]) -> TokenUse:
    counts = [run.record.agent.tokens for run in runs if run.record.agent.tokens is not None]
    uses = [(run.record.agent.model_use, run.record.agent.tokens) for run in runs]
    known = [(use, use.difference(tokens) or 0.0) for use, tokens in uses if use is not None]
    costs = [tokens.cost for tokens in counts if tokens.cost is not None]
    return TokenUse(
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
