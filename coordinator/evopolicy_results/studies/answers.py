"""A report's first screen in sentences: who leads and by how much, who cannot be told apart, what the runs cost, and
what is wrong with the data. Every number is one of the report's tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import msgspec

from evopolicy_common.statistics.intervals import Estimate
from evopolicy_common.terminal import counted, duration, number
from evopolicy_results.reading.environments import title_of
from evopolicy_results.reading.records import PastRun
from evopolicy_results.scoring.scores import Cell
from evopolicy_results.statistics.intervals import decimals, rounded, valued
from evopolicy_results.statistics.pairs import Pair
from evopolicy_results.statistics.standings import RankEstimate
from evopolicy_results.studies.study import Study, SuiteStudy

_NAMED = 6
"""Names that a sentence lists."""


class Leader(msgspec.Struct, frozen=True, kw_only=True):
    """The leader of one suite."""

    suite: str
    entry: str
    """Empty where no agent leads."""
    lead: str
    """By how much."""
    apart: str
    """The entries that can be told apart from it, and those that cannot."""


class Answers(msgspec.Struct, frozen=True, kw_only=True):
    scope: str
    leaders: tuple[Leader, ...]
    cost: str
    troubles: tuple[str, ...]
    """Faults of the data; empty if none is known."""


def answers_of(study: Study) -> Answers:
    cells = [cell for suite in study.suites for cell in suite.table.cells.values() if cell.fixed is None]
    n_envs = len({cell.env for cell in cells})
    n_started = sum(run.record.start is not None for run in study.runs)
    scope = [
        counted(len(study.entries), "agent"),
        counted(n_envs, "environment"),
        counted(len(study.runs), "run") + (f" ({n_started} of these from a submit)" if n_started else ""),
    ]
    if cells:
        scope.append(f"{_spread((cell.n_runs for cell in cells), 'run')} a cell")
        scope.append(
            f"{_spread((len(run.returns) for cell in cells for run in cell.runs), 'held-out case')} a run"
        )
    return Answers(
        scope=", ".join(scope),
        leaders=tuple((_of_ranks if each.is_ranked else _of_returns)(each) for each in study.suites),
        cost=_cost(study.runs),
        troubles=tuple(_troubles(study, cells)),
    )


def _spread(counts: Iterable[int], noun: str) -> str:
    known = sorted(set(counts))
    return counted(known[0], noun) if len(known) == 1 else f"{known[0]} to {counted(known[-1], noun)}"


def _names(names: Sequence[str]) -> str:
    shown, more = list(names[:_NAMED]), len(names) - _NAMED
    if more > 0:
        return f"{', '.join(shown)} and {more} more"
    return " and ".join(filter(None, (", ".join(shown[:-1]), shown[-1])))


def _of_ranks(suite: SuiteStudy) -> Leader:
    rows, estimates = suite.board.standings, suite.statistics.standings
    agents = [row for row in rows if not row.is_reference and row.score is not None]
    if not agents or rows[0].is_reference:
        why = "No agent is above the random policy." if agents else "No agent has played every environment."
        return Leader(suite=suite.title, entry="", lead=why, apart="")
    first = agents[0]
    own = estimates.of(first.entry)
    lead = f"mean rank score {_scored(first.score, own)}"
    if len(agents) > 1:
        second = agents[1]
        lead += f", before {second.entry} with {_scored(second.score, estimates.of(second.entry))}"
    lead += f"; first on {first.wins} of {counted(first.n_environments, 'environment')}."
    if own is None:
        return Leader(
            suite=suite.title, entry=first.entry, lead=lead, apart="Its runs show no spread: no interval."
        )
    tied = [
        row.entry
        for row in agents[1:]
        if (other := estimates.of(row.entry)) is None or set(own.ties) & set(other.ties)
    ]
    return Leader(suite=suite.title, entry=first.entry, lead=lead, apart=_apart(tied, len(agents) - 1))


def _scored(score: float | None, estimate: RankEstimate | None) -> str:
    """A rank score with its interval."""
    value = score or 0.0
    if estimate is None:
        return rounded(value, 2)
    if decimals(estimate.score_low, estimate.score_high) is None:
        return f"{rounded(value, 2)} (in all resamples)"
    return valued(Estimate(value=value, low=estimate.score_low, high=estimate.score_high))


def _of_returns(suite: SuiteStudy) -> Leader:
    (env,) = suite.table.environments
    column = suite.table.column(env)
    agents = [entry for entry in suite.table.agents if column.get(entry) is not None]
    agents.sort(key=lambda entry: -(column[entry] or 0.0))
    random = None if suite.table.reference is None else column.get(suite.table.reference)
    if not agents or (random is not None and (column[agents[0]] or 0.0) <= random):
        why = "No agent is above the random policy." if agents else "No agent has a score."
        return Leader(suite=suite.title, entry="", lead=why, apart="")
    first = agents[0]
    own = suite.statistics.means.get((first, env))
    lead = f"mean return {number(column[first]) if own is None else valued(own)}"
    pairs = {
        pair.second if pair.first == first else pair.first: pair
        for pair in suite.statistics.pairs
        if first in (pair.first, pair.second)
    }
    gap = None if len(agents) < 2 or agents[1] not in pairs else _turned(pairs[agents[1]], first)
    if gap is not None:
        lead += f", {valued(gap)} above {agents[1]}"
    elif len(agents) > 1:
        lead += f", before {agents[1]} with {number(column[agents[1]])}"
    if random is not None:
        lead += f"; random actions return {number(random)}"
    better = {
        other
        for other, pair in pairs.items()
        if pair.verdict == ("first" if pair.first == first else "second")
    }
    tied = [entry for entry in agents[1:] if entry not in better]
    few = [entry for entry in tied if entry in pairs and pairs[entry].verdict == "too few runs"]
    tied = [entry for entry in tied if entry not in few]
    texts = [] if few and not tied else [_apart(tied, len(agents) - 1 - len(few))]
    if few:
        needed = max(pairs[entry].n_needed or 0 for entry in few)
        texts.append(f"Too few runs for a verdict on {_names(few)}; about {needed} of each would do.")
    return Leader(suite=suite.title, entry=first, lead=f"{lead}.", apart=" ".join(texts))


def _turned(pair: Pair, entry: str) -> Estimate | None:
    """The difference as `entry` minus the other."""
    gap = pair.gap
    if gap is None or pair.first == entry:
        return gap
    ends = (None, None) if gap.low is None or gap.high is None else (-gap.high, -gap.low)
    return msgspec.structs.replace(gap, value=-gap.value, low=ends[0], high=ends[1])


def _apart(tied: Sequence[str], n_others: int) -> str:
    if not n_others:
        return "There is no other agent to compare with."
    if not tied:
        return "The difference to every other agent is significant at 5 %."
    return f"Not told apart from it at 5 %: {_names(tied)}."


def _cost(runs: Sequence[PastRun]) -> str:
    tokens = [run.record.agent.tokens for run in runs]
    known = [each for each in tokens if each is not None]
    costs = [each.cost for each in known if each.cost is not None]
    episodes = sum(run.submits[-1].consumed for run in runs if run.submits)
    wall = sum(run.record.timing.wall_time_seconds for run in runs)
    parts = [counted(episodes, "train episode"), f"{duration(wall)} of run time in total"]
    if known:
        total = sum(each.total for each in known)
        parts.append(f"{total / 1e6:,.1f} million tokens" if total >= 1e6 else f"{total:,} tokens")
    if costs:
        of = f" (known for {len(costs)} of {len(runs)} runs)" if len(costs) < len(runs) else ""
        parts.append(f"${sum(costs):,.2f}{of}")
    return ", ".join(parts) + ("." if costs else "; no run records what its model cost.")


_REMARKS: tuple[tuple[Callable[[PastRun], bool], str], ...] = (
    (lambda run: run.record.outcome.status == "no_ok_submit", "have no working submit and rank last."),
    (lambda run: run.record.versions.env_deterministic is not True,
     "played an environment whose episodes are not confirmed to repeat."),
    (lambda run: not run.record.versions.data_secret,
     "played public splits, of case files or a public seed: agents and models may know the hidden cases."),
    (lambda run: run.record.experiment_dimensions.simulation == "allowed", "let their agent simulate."),
    (lambda run: run.record.line.jail == "none", "had no jail around their agent, or that of a run they start from."),
    (lambda run: run.record.hidden_isolation == "unknown",
     "do not record whether hidden episodes and agents shared a kernel."),
    (lambda run: run.record.hidden_isolation == "shared",
     "were played while hidden episodes and agents could share a kernel (--hidden-isolation off)."),
    (lambda run: run.record.hidden_isolation == "waived",
     "had agents whose place the operator vouched for (--agent-host elsewhere)."),
    (lambda run: run.record.experiment_dimensions.hidden_cases == "per_run",
     "had hidden cases of their own: no two scores are on the same cases, so differences between runs cannot be"
     " paired by case."),
)  # fmt: skip
"""Remarks on runs, each after the condition under which it holds of a run."""


def _troubles(study: Study, cells: Sequence[Cell]) -> Iterable[str]:
    for suite in study.suites:
        for one in suite.board.incomplete:
            missing = _names([title_of(env) for env in one.missing])
            yield f"{one.entry} has no run on {missing}: it is not ranked on {suite.title}."
    if study.left_out:
        yield f"{counted(len(study.left_out), 'folder')} left out: failed, unfinished, or repeated (section Left out)."
    if study.mixtures:
        yield f"The runs differ in settings that a comparison holds fixed: {'; '.join(map(str, study.mixtures))}."
    if single := [cell for cell in cells if cell.n_runs == 1]:
        of = "Every cell has" if len(single) == len(cells) else f"{len(single)} of {len(cells)} cells have"
        yield f"{of} one run: this compares checkpoints, not agents, as one run does not show how an agent's runs vary."
    for cell in [cell for cell in cells if cell.repeated][:_NAMED]:
        yield f"{cell.entry} on {title_of(cell.env)}: {cell.repeated}."
    for holds, text in _REMARKS:
        if n := sum(map(holds, study.runs)):
            yield f"{n} of {len(study.runs)} runs {text}"
