"""Audit signals and token accounting of each run (paper, appendix: audit signals, token and cost accounting).

These are diagnostics: no score depends on them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import fmean
from typing import Any, TypeVar

import msgspec

from evopolicy_results.behaviour.edits import classify
from evopolicy_results.reading.environments import ordered_environments
from evopolicy_results.reading.records import Run

_Value = TypeVar("_Value")


class AuditSignals(msgspec.Struct, frozen=True, kw_only=True):
    """Audit signals of one run."""

    run: str
    entry: str
    env: str
    accepted: int
    """Submits that were charged."""
    rejected: int | None
    """Requests refused before the snapshot, not charged. None, as in the fields below, if the run has no record of
    them."""
    not_ok: int
    """Accepted submits that are not ok."""
    invalid_rate: float | None
    """Invalid-transition rate: accepted submits that are not ok, of all accepted; None without any."""
    repaired_rate: float | None
    """Invalid-action rate: share of train steps whose action was repaired; None if the run has no record of it."""
    budget: int
    budget_used: int
    """In episodes."""
    episodes_per_submit: float | None
    """Mean over accepted submits."""
    failed_episodes: int
    """Train episodes in which the policy failed."""
    score_drops: int
    """Score-bearing submits with a validation mean below that of the previous one."""
    selected_index: int | None
    complexity_growth: float | None
    """AST nodes of the selected source bundle divided by those of the first score-bearing one."""
    retries: int | None
    turns: int | None
    wall_s: float
    agent_s: float | None
    queue_s: float | None
    rollout_s: float | None
    feedback_s: float | None
    finalise_s: float | None
    secret_splits: bool
    """False when the splits came from a small public seed."""
    jail: str
    hidden_isolation: str
    """Whether hidden episodes and agents shared a kernel: `exclusive`, `shared`, `waived`, `unknown`."""
    hidden_cases: str
    """`shared`, or `per_run`."""
    simulation: str
    """Whether the run's rules let its agent simulate: `forbidden`, `allowed`."""
    simulator_flags: int | None
    """Places in its code that look like a simulator; None if simulation was allowed."""
    signals: int
    """Places in its log and code that deserve a look."""


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
    """Who counted: `relay`, `agent`, or both in different runs; empty in files of earlier versions."""
    hosted_tools: str = ""
    """Kinds of tools of the provider that requests offered to the model."""
    differing: int = 0
    """Runs in which the agent's own count differs from the relay's by more than `COUNTS_DIFFER`."""


def audit_signals(runs: Iterable[Run]) -> list[AuditSignals]:
    """One record per run, in the order of `runs`."""
    return [_signals(run) for run in runs]


def _signals(run: Run) -> AuditSignals:
    transitions = classify(run.submits)
    scored = run.scored
    selected = run.selected
    accepted = len(run.submits)
    not_ok = sum(submit.status != "ok" for submit in run.submits)
    growth = None
    if scored and selected is not None and selected.source is not None and scored[0].source is not None:
        first = scored[0].source.features.nodes
        growth = selected.source.features.nodes / first if first else None
    timing = run.record.timing
    return AuditSignals(
        run=run.name,
        entry=run.entry,
        env=run.env,
        accepted=accepted,
        rejected=_recorded(run, len(run.record.rejected_submits)),
        not_ok=not_ok,
        invalid_rate=not_ok / accepted if accepted else None,
        repaired_rate=_repaired_rate(run.record.outcome.auxiliary.get("transitions")),
        budget=run.budget,
        budget_used=run.submits[-1].consumed if run.submits else 0,
        episodes_per_submit=fmean(submit.n_episodes for submit in run.submits) if run.submits else None,
        failed_episodes=sum(submit.n_failed_episodes for submit in run.submits),
        score_drops=sum(t.val_drop for t in transitions),
        selected_index=run.record.outcome.best_submit_index,
        complexity_growth=growth,
        retries=_recorded(run, run.record.agent.retries),
        turns=_recorded(run, run.record.agent.turns),
        wall_s=timing.wall_time_seconds,
        agent_s=_recorded(run, timing.agent_s),
        queue_s=_recorded(run, timing.queue_s),
        rollout_s=_recorded(run, timing.rollout_s),
        feedback_s=_recorded(run, timing.feedback_s),
        finalise_s=_recorded(run, timing.finalise_s),
        secret_splits=run.record.versions.data_secret,
        jail=run.record.jail,
        hidden_isolation=run.record.hidden_isolation,
        hidden_cases=run.record.experiment_dimensions.hidden_cases,
        simulation=run.record.experiment_dimensions.simulation,
        simulator_flags=None if run.simulation_allowed else len(run.simulator_flags),
        signals=len(run.signals),
    )


def _repaired_rate(transitions: Any) -> float | None:
    counts = transitions if isinstance(transitions, dict) else {}
    steps, invalid = counts.get("steps"), counts.get("action_invalid")
    if not isinstance(steps, int) or not isinstance(invalid, int) or not 0 <= invalid <= steps or not steps:
        return None
    return invalid / steps


def _recorded(run: Run, value: _Value) -> _Value | None:
    """Passes a value that the published software does not record; None for its runs."""
    return None if run.is_published else value


def token_use(runs: Sequence[Run]) -> list[TokenUse]:
    """Every (environment, entry) that was played, environments in catalogue order, entries by name."""
    cells: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        cells.setdefault((run.env, run.entry), []).append(run)
    place = {env: i for i, env in enumerate(ordered_environments(env for env, _ in cells))}
    keys = sorted(cells, key=lambda key: (place[key[0]], key[1].casefold(), key[1]))
    return [_token_use(env, entry, cells[env, entry]) for env, entry in keys]


def _token_use(env: str, entry: str, runs: list[Run]) -> TokenUse:
    counts = [run.record.agent.tokens for run in runs if run.record.agent.tokens is not None]
    uses = [(run.record.agent.model_use, run.record.agent.tokens) for run in runs]
    apart = [use.difference(tokens) or 0.0 for use, tokens in uses if use is not None]
    costs = [tokens.cost for tokens in counts if tokens.cost is not None]
    return TokenUse(
        entry=entry,
        env=env,
        n_runs=len(counts),
        input_noncached=fmean(t.input_noncached for t in counts) / 1e6 if counts else None,
        cache=fmean(t.cache_read + t.cache_creation for t in counts) / 1e6 if counts else None,
        output=fmean(t.output for t in counts) / 1e6 if counts else None,
        cost=fmean(costs) if counts and len(costs) == len(counts) else None,
        metering=", ".join(sorted({use.metering for use, _ in uses if use is not None})),
        hosted_tools=", ".join(
            sorted({kind for use, _ in uses if use is not None for kind in use.hosted_tools})
        ),
        differing=sum(each > COUNTS_DIFFER for each in apart),
    )
