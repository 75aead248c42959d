"""The report's tables about the runs: setups of agents and environments, the runs, their diagnostics, their submits
with the preceding feedback, and the omitted runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from operator import itemgetter
from statistics import fmean
from typing import Any, NamedTuple

from msgspec.structs import replace

from evopolicy_common import catalogue
from evopolicy_results.behaviour.audit import PHASES
from evopolicy_results.behaviour.edits import Transition, classify, demand_of
from evopolicy_results.behaviour.trace import Trace
from evopolicy_results.reading.agent_log import Evidence
from evopolicy_results.reading.environments import (
    family_of,
    family_title,
    grouped,
    ordered_environments,
    title_of,
)
from evopolicy_results.reading.records import PastRun, PastSubmit, path_text
from evopolicy_results.studies.study import Study
from evopolicy_results.tables.table import Column, Kind, Table, at, rows_of, tabulated

ENTRY = Column("entry", "Agent")
HARNESS = Column("harness", "Harness")
ENV = Column("env", "Environment", of=lambda record: title_of(record.env))
RUN = Column("run", "Run", of=lambda record: _short(record.run))
RUNS = Column("runs", "Runs", "integer", of="n_runs")

_COUNTERS = frozenset({"reprompted", "paused_s", "requests_failed", "resumed"})
"""Counters of a run's course that a harness stores among its settings; they are not settings."""
_MAX_QUOTE = 240
_JOURNAL = (
    "Entry with the run's result, and the journal's head there. A head that you noted earlier shows whether the"
    " journal was rewritten."
)


def tables_of_runs(study: Study) -> list[Table]:
    published = [run for run in study.runs if run.is_published]
    missing = [
        (table, value, sum(not (path and at(run, path)) for run in published))
        for table, value, path in _MISSING
    ]
    return [
        tabulated(
            "runs",
            "Runs",
            (
                ENV,
                ENTRY,
                replace(RUN, of=lambda run: _short(run.name)),
                Column("submits", "Submits", "integer", of=lambda run: len(run.submits)),
                Column("score", "Held-out mean", "number"),
                Column("journal", "Journal", note=_JOURNAL, of=_journal),
            ),
            study.runs,
            "Open a run for its feedback use, timeline, checkpoints and differences.",
            run=lambda run: run.name,
        ),
        _audit(study.runs),
        _agents(study.runs),
        _environments(study.runs),
        tabulated(
            "not_told",
            "Missing values",
            (
                Column("table", "Table", of=itemgetter(0)),
                Column("what", "Missing value", of=itemgetter(1)),
                Column("runs", "Runs", "integer", of=itemgetter(2)),
            ),
            [each for each in missing if each[2]],
            "Values that run directories of the published software lack, by table. They are left empty.",
        ),
        tabulated(
            "left_out",
            "Left out",
            (Column("path", "Folder", of=lambda item: path_text(item.path)), Column("reason", "Reason")),
            study.left_out,
            "Folders that are no complete run, and why. They are in no table and no figure.",
        ),
    ]


def one_or_all(values: Iterable[object]) -> object:
    """The common value of all, or `A or B` if different runs were mixed; None without any."""
    distinct = list(dict.fromkeys(values))
    return distinct[0] if len(distinct) == 1 else " or ".join(map(str, distinct)) or None


def _short(run: str) -> str:
    """The experiment in a run's name: agent and environment have columns of their own."""
    return run.rsplit(" / ", 1)[-1]


def _journal(run: PastRun) -> str | None:
    """None for runs of the published software."""
    place = run.record.committed
    return None if place is None or place.ended is None else f"{place.ended} {place.ended_head[:16]}"


_LINE = "The weakest of a run and of those that it starts from."


def _agents(runs: Iterable[PastRun]) -> Table:
    """One row per setup of an entry: several rows show that its runs differ."""
    version = "Of the harness's program."
    isolation = "exclusive: hidden episodes and agents never shared a kernel."
    setup = (
        ENTRY,
        HARNESS,
        Column("cli_version", "Version", note=version, of="record.agent.cli_version"),
        Column("model", "Model string", of="record.agent.model_string"),
        Column("settings", "Settings", of=_settings),
        Column("jail", "Jail", note=_LINE, of="record.line.jail"),
        Column(
            "hidden_isolation", "Hidden isolation", note=isolation, of=lambda r: r.record.hidden_isolation
        ),
    )
    counts = Counter(tuple(value or "" for value in row.values()) for row in rows_of(runs, setup))
    return Table(
        name="agents",
        title="Agents",
        caption="How each agent was set up, as its run directories record it; an agent with several rows was not"
        " the same in all of its runs.",
        columns=(*setup, RUNS),
        rows=tuple(
            {**{c.key: value or None for c, value in zip(setup, values, strict=True)}, "runs": counts[values]}
            for values in sorted(counts, key=lambda values: (values[0].casefold(), values))
        ),
    )


def _settings(run: PastRun) -> str:
    """The plain settings on one line; lists and paths of the original machine are only in run.json."""
    texts: dict[type, Callable[[Any], Any]] = {bool: _YES_NO.get, float: "{:g}".format}
    return ", ".join(
        f"{key} {texts.get(type(value), str)(value)}"
        for key, value in run.record.agent.settings.items()
        if isinstance(value, str | int | float)
        and key not in _COUNTERS
        and not str(value).startswith(("/", "~"))
    )


def _environments(runs: Iterable[PastRun]) -> Table:
    by_env = grouped(runs, lambda run: run.env)

    def common(key: str, title: str, kind: Kind, of: Callable[[PastRun], object], note: str = "") -> Column:
        return Column(key, title, kind, note=note, of=lambda env: one_or_all(map(of, by_env[env])))

    def dimension(name: str) -> Callable[[PastRun], object]:
        return lambda run: getattr(run.record.experiment_dimensions, name) or None

    def spaces(env: str) -> str | None:
        return f"{known[env].observation}/{known[env].action}" if env in known else None

    def steps(env: str) -> int | None:
        return known[env].max_episode_steps if env in known else None

    known = catalogue.entries()
    version = common("version", "Version", "text", lambda run: run.record.versions.env)

    def repeats(run: PastRun) -> str:
        return _YES_NO[run.record.versions.env_deterministic]

    note = "How long one policy object lives."
    repeated = "Whether seed and actions determine an episode; where not, `verify` plays none again."
    table = tabulated(
        "environments",
        "Environments",
        (
            replace(ENV, of=title_of),
            Column("family", "Family", of=lambda env: family_title(family_of(env))),
            Column("id", "Suite id", of=str),
            version,
            Column("spaces", "Obs./action", of=spaces),
            Column("demand", "Demand", of=demand_of),
            Column("steps", "Longest episode (steps)", "integer", of=steps),
            common("budget", "Budget", "integer", lambda run: run.budget, "Train episodes of a run."),
            common("submit", "Episodes a submit", "text", lambda run: run.submit_size, "Fewest to most."),
            common("validation", "Validation cases", "integer", dimension("n_validation")),
            common("heldout", "Held-out cases", "integer", dimension("n_heldout")),
            common("scope", "Policy scope", "text", dimension("policy_scope"), note),
            common("repeats", "Episodes repeat", "text", repeats, repeated),
        ),
        ordered_environments(by_env),
        "The cases of a run's hidden splits, and the train episodes that it could spend.",
    )
    return replace(table, columns=(*(each for each in table.columns if each is not version), version))


class _Of(NamedTuple):
    """A submit, with what its run's trace has of it."""

    run: PastRun
    submit: PastSubmit
    transition: Transition | None
    evidence: Evidence


_YES_NO = {True: "yes", False: "no"}
_FEEDBACK = (
    Column("env", "Environment", of=lambda one: title_of(one.run.env)),
    Column("entry", "Agent", of="run.entry"),
    Column("run", "Run", of=lambda one: _short(one.run.name)),
    Column("submit", "Submit", of="submit.label"),
    Column("before", "Budget before", "integer", of="submit.consumed_before"),
    Column("after", "Budget after", "integer", of="submit.consumed"),
    Column("read", "Evidence read", of=lambda one: ", ".join(one.evidence.read) or None),
    Column("said", "The agent's own words", of=lambda one: _quote(one.evidence)),
    Column("status", "Status", of="submit.status"),
    Column("edit", "Edit", of="transition.edit"),
    Column("changed_lines", "Changed lines", "integer", of="submit.changed_lines"),
    Column("visible", "Visible mean", "number", of="submit.mean_return"),
    Column("validation", "Validation mean", "number", of="submit.val_mean"),
    Column("best", "New validation best", of=lambda one: (t := one.transition) and _YES_NO[t.hit]),
    Column("selected", "Selected", of=lambda one: "yes" if one.submit is one.run.selected else None),
)


def submits_of(trace: Trace) -> list[dict[str, object]]:
    """A run's rows of the table of feedback use."""
    run, transitions, evidence = trace.run, trace.transitions, trace.evidence
    submits = [
        _Of(run, one, transitions.get(one.index), evidence.get(one.index, Evidence())) for one in run.submits
    ]
    return rows_of(submits, _FEEDBACK)


def _quote(evidence: Evidence) -> str:
    quote = " ".join(evidence.attribution.split())
    return quote if len(quote) <= _MAX_QUOTE else quote[: _MAX_QUOTE - 1] + "…"


def feedback_use(rows: Iterable[dict[str, object]]) -> Table:
    """Every submit of every run (`submits_of`). Too long for a page; each run has a page of its own."""
    return Table(
        name="feedback_use",
        title="Feedback use",
        caption="One row a submit: what the agent had read and said since the submit before, how the policy"
        " changed, and what came of it. Budget: train episodes consumed before and after. Validation is"
        " hidden from agents.",
        columns=_FEEDBACK,
        rows=tuple(rows),
    )


def _audit_row(run: PastRun) -> dict[str, object]:
    record, submits, selected = run.record, run.submits, run.record.outcome.best_submit_index
    dimensions = record.experiment_dimensions
    not_ok = sum(submit.status != "ok" for submit in submits)
    compared = (*run.scored[:1], run.selected)
    nodes = [each.source.features.nodes for each in compared if each and each.source]

    def recorded(value: object) -> object:
        return None if run.is_published else value

    return {
        "run": _short(run.name),
        "entry": run.entry,
        "env": title_of(run.env),
        "accepted": len(submits),
        "rejected": recorded(len(record.rejected_submits)),
        "not_ok": not_ok,
        "invalid_rate": not_ok / len(submits) if submits else None,
        "repaired_rate": _repaired_rate(record.outcome.auxiliary.get("transitions")),
        "budget": run.budget,
        "budget_used": submits[-1].consumed if submits else 0,
        "episodes_per_submit": fmean(submit.n_episodes for submit in submits) if submits else None,
        "failed_episodes": sum(submit.n_failed_episodes for submit in submits),
        "score_drops": sum(transition.val_drop for transition in classify(submits)),
        "selected_index": selected,
        "complexity_growth": nodes[1] / nodes[0] if len(nodes) == 2 and nodes[0] else None,
        "retries": recorded(record.agent.retries),
        "turns": recorded(record.agent.turns),
        "wall_s": record.timing.wall_time_seconds,
        **{phase: recorded(getattr(record.timing, phase)) for phase in PHASES},
        "secret_splits": record.versions.data_secret,
        "jail": record.line.jail,
        "hidden_isolation": record.hidden_isolation,
        "hidden_cases": dimensions.hidden_cases,
        "simulation": dimensions.simulation,
        "selected": None if selected is None else f"s{selected:03d}",
        "splits": "secret" if record.versions.data_secret else "public",
    }


def _repaired_rate(transitions: object) -> float | None:
    """Share of train steps whose action was repaired; None if the run has no record of it."""
    counts = transitions if isinstance(transitions, dict) else {}
    steps, invalid = counts.get("steps"), counts.get("action_invalid")
    if not isinstance(steps, int) or not isinstance(invalid, int) or not 0 <= invalid <= steps or not steps:
        return None
    return invalid / steps


def _audit(runs: Iterable[PastRun]) -> Table:
    """Diagnostics: no score depends on them. Runs of the published software record only some of them."""
    repaired = "Share of the train steps whose action was outside the action space."
    splits = "`public`: of case files or a public seed that anybody may know."
    return Table(
        name="audit",
        title="Audit signals",
        caption="One row a run. Invalid submits: accepted ones that are not ok, of all accepted. Repaired"
        " actions: share of the train steps whose action was outside the action space; a dash where they"
        " were not counted. Score drops: score-bearing submits whose validation mean is below the one before."
        " Growth: AST nodes of the selected policy over those of the first. Wall time by phase, in seconds;"
        " phases may overlap.",
        columns=(
            ENV,
            ENTRY,
            RUN,
            Column("accepted", "Accepted", "integer"),
            Column("rejected", "Rejected", "integer"),
            Column("invalid_rate", "Invalid submits", "percent"),
            Column("repaired_rate", "Repaired actions", "number", digits=4, below=True, note=repaired),
            Column("budget_used", "Budget used", "integer"),
            Column("episodes_per_submit", "Episodes / submit", "number", digits=1),
            Column("failed_episodes", "Failed episodes", "integer"),
            Column("score_drops", "Score drops", "integer"),
            Column("selected", "Selected"),
            Column("complexity_growth", "Growth (×)", "number", digits=2),
            Column("turns", "Turns", "integer"),
            Column("retries", "Retries", "integer"),
            Column("splits", "Splits", note=splits),
            Column("simulation", "Simulation", note="Whether the run's rules let the agent simulate."),
            *(
                Column(phase, f"{phase.removesuffix('_s').capitalize()} (s)", "number", digits=0)
                for phase in ("wall_s", *PHASES)
            ),
        ),
        rows=tuple(map(_audit_row, runs)),
        runs=tuple(run.name for run in runs),
    )


_REFERENCE, _VALIDATION = "record.outcome.random_reference", "record.outcome.val_scores"
_MISSING = (
    ("Normalised performance", "the random reference on the held-out cases", _REFERENCE),
    (
        "Score evolution",
        "the random reference: the scale begins at the lowest first score instead",
        _REFERENCE,
    ),
    ("Score evolution", "validation means, so no curve", _VALIDATION),
    ("Edit types, edit size", "validation means, so no hits", _VALIDATION),
    ("Realised structure", "the selected policy's source", "selected.source"),
    ("Tokens and cost", "tokens and cost", "record.agent.tokens"),
    ("Audit signals", "refused requests, turns, retries, the phases of the wall time", ""),
    ("Agents", "harness, version, settings, jail, hidden isolation", ""),
    ("Environments", "the bounds of a submit, the number of validation cases", ""),
)
"""Table, the information that it lacks for runs of the published software, and its place in a run that may have it."""
