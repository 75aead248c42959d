"""Runs that start from a submit of an earlier run: those from one state, compared with each other and no other run.

Rules that this module owns:
- Such a run is on no leaderboard and in no mean of its entry: part of its policy is another run's.
- Runs from one state may differ in agent, model, feedback, prompts and AGENTS.md, which are in their label then. They
  are paired by hidden case; Holm's correction is over all pairs from one state.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec

from evopolicy_common.messages.run_settings import Start
from evopolicy_common.statistics.intervals import RESAMPLES
from evopolicy_results.reading.environments import grouped
from evopolicy_results.reading.records import PastRun
from evopolicy_results.scoring.scores import Cell, returns_of
from evopolicy_results.statistics.pairs import Pair, pairs

VARIED = ("feedback detail", "text of AGENTS.md", "prompts")
"""Settings, by their names in `comparability`, in which runs from one state may differ."""


class StartGroup(msgspec.Struct, frozen=True, kw_only=True):
    """All runs from one state."""

    start: Start
    parent: str
    """Entry and experiment of the earlier run; the coordinator's name of it where it is not among the runs."""
    env: str
    variants: dict[str, int]
    """Label to number of runs."""
    parent_scored: bool
    """Whether any of them was started when a result could have chosen the place."""
    pairs: tuple[Pair, ...]


def by_state(runs: Iterable[PastRun]) -> dict[tuple[str, int, str], list[PastRun]]:
    """Runs that start from a submit, by its run, index and tree."""
    started = [(run, run.record.start) for run in runs if run.record.start is not None]
    groups = grouped(started, lambda one: (one[1].run, one[1].submit_index, one[1].tree))
    return {state: [run for run, _ in group] for state, group in groups.items()}


def start_groups(runs: Sequence[PastRun], *, resamples: int = RESAMPLES) -> list[StartGroup]:
    names = {run.record.run: f"{run.entry} / {run.record.exp_id}" for run in runs if run.record.run}
    out = []
    for (parent, _, _), group in by_state(runs).items():
        variants: dict[str, list[PastRun]] = {}
        for run, label in zip(group, _labels(group), strict=True):
            variants.setdefault(label, []).append(run)
        env, starts = group[0].env, [run.record.start for run in group if run.record.start is not None]
        samples = {
            (label, env): Cell(entry=label, env=env, runs=tuple(map(returns_of, several)))
            for label, several in variants.items()
        }
        out.append(
            StartGroup(
                start=starts[0],
                parent=names.get(parent, parent),
                env=env,
                variants={label: len(several) for label, several in variants.items()},
                parent_scored=any(start.parent_scored for start in starts),
                pairs=tuple(pairs(samples, list(variants), [env], resamples=resamples)),
            )
        )
    return out


def _labels(runs: Sequence[PastRun]) -> list[str]:
    """The entry of each run, with the settings in which they differ."""
    described = [
        {
            "feedback": run.record.experiment_dimensions.feedback,
            "AGENTS.md": run.record.experiment_dimensions.agents_md.removeprefix("sha256:")[:8] or "standard",
            "prompts": run.record.agent.prompts.removeprefix("sha256:")[:8] or "standard",
        }
        for run in runs
    ]
    differing = [name for name in described[0] if len({each[name] for each in described}) > 1]
    return [
        ", ".join([run.entry, *(f"{name} {each[name]}" for name in differing)])
        for run, each in zip(runs, described, strict=True)
    ]
