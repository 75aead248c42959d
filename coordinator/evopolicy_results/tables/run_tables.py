"""The report's tables about the runs: setups of agents and environments, the runs, their audit signals, their submits
with the preceding feedback, and the omitted runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from operator import itemgetter
from typing import Any

from msgspec.structs import replace

from evopolicy_common import catalogue
from evopolicy_results.behaviour.audit import PHASES, AuditSignals
from evopolicy_results.behaviour.edits import demand_of
from evopolicy_results.behaviour.trace import Trace
from evopolicy_results.reading.agent_log import Evidence
from evopolicy_results.reading.environments import (
    family_of,
    family_title,
    grouped,
    ordered_environments,
    title_of,
)
from evopolicy_results.reading.records import Run, path_text
from evopolicy_results.scan.signals import TITLES, Signal
from evopolicy_results.studies.study import Study
from evopolicy_results.tables.table import Column, Table, rows_of, tabulated

ENTRY = Column("entry", "Agent")
HARNESS = Column("harness", "Harness")
ENV = Column("env", "Environment", of=lambda record: title_of(record.env))
RUN = Column("run", "Run", of=lambda record: _short(record.run))
RUNS = Column("runs", "Runs", "integer", of=lambda record: record.n_runs)

_COUNTERS = frozenset({"reprompted", "paused_s", "requests_failed", "resumed"})
"""Counters of a run's course that a harness stores among its settings; they are not settings."""
_MAX_QUOTE = 240


def tables_of_runs(study: Study) -> list[Table]:
    signals = [(run, each) for run in study.runs for each in run.signals]
    simulators = [(run, each) for run in study.runs for each in run.simulator_flags]
    return [
        _runs(study),
        _audit(study),
        _evidence(signals, "signals", "What deserves a look", _SIGNALS),
        _evidence(simulators, "simulator_flags", "Code that looks like a simulator", _SIMULATORS),
        _agents(study),
        _environments(study),
        _missing(study),
        tabulated(
            study.left_out,
            (Column("path", "Folder", of=lambda item: path_text(item.path)), Column("reason", "Reason")),
            name="left_out",
            title="Left out",
            caption="Folders that are no complete run, and why. They are in no table and no figure.",
        ),
    ]


def one_or_all(values: Iterable[Any]) -> Any:
    """The common value of all, or `A or B` if different runs were mixed; None without any."""
    distinct = list(dict.fromkeys(values))
    return distinct[0] if len(distinct) == 1 else " or ".join(map(str, distinct)) or None


def _short(run: str) -> str:
    """The experiment in a run's name: agent and environment have columns of their own."""
    return run.rsplit(" / ", 1)[-1]


def _runs(study: Study) -> Table:
    def journal(run: Run) -> str | None:
        """None for runs from before the journal existed."""
        place = run.record.committed
        return None if place is None or place.ended is None else f"{place.ended} {place.ended_head[:16]}"

    note = (
        "Entry with the run's result, and the journal's head there. A head that you noted earlier shows whether the"
        " journal was rewritten."
    )
    return tabulated(
        study.runs,
        (
            ENV,
            ENTRY,
            replace(RUN, of=lambda run: _short(run.name)),
            Column("submits", "Submits", "integer", of=lambda run: len(run.submits)),
            Column("score", "Held-out mean", "number"),
            Column("journal", "Journal", note=note, of=journal),
        ),
        run=lambda run: run.name,
        name="runs",
        title="Runs",
        caption="Open a run for its feedback use, timeline, checkpoints and differences.",
    )


def _agents(study: Study) -> Table:
    """One row per setup of an entry: several rows show that its runs differ."""
    note = "exclusive: hidden episodes and agents never shared a kernel."
    setup = (
        ENTRY,
        HARNESS,
        Column(
            "cli_version",
            "Version",
            note="Of the harness's program.",
            of=lambda run: run.record.agent.cli_version,
        ),
        Column("model", "Model string", of=lambda run: run.record.agent.model_string),
        Column("settings", "Settings", of=_settings),
        Column("jail", "Jail", of=lambda run: run.record.jail),
        Column("hidden_isolation", "Hidden isolation", note=note, of=lambda run: run.record.hidden_isolation),
    )
    counts = Counter(tuple(value or "" for value in row.values()) for row in rows_of(study.runs, setup))
    return Table(
        name="agents",
        title="Agents",
        caption=(
            "How each agent was set up, as its run directories tell; an agent with several rows was not the same in all"
            " of its runs."
        ),
        columns=(*setup, RUNS),
        rows=tuple(
            {**{c.key: value or None for c, value in zip(setup, values, strict=True)}, "runs": counts[values]}
            for values in sorted(counts, key=lambda values: (values[0].casefold(), values))
        ),
    )


def _settings(run: Run) -> str:
    """The plain settings on one line; lists and paths of the original machine are only in run.json."""
    settings = run.record.agent.settings
    plain = {
        key: value
        for key, value in settings.items()
        if isinstance(value, str | int | float)
        and key not in _COUNTERS
        and not str(value).startswith(("/", "~"))
    }
    words = {True: "yes", False: "no"}
    return ", ".join(
        f"{key} {words[value] if isinstance(value, bool) else f'{value:g}' if isinstance(value, float) else value}"
        for key, value in plain.items()
    )


def _environments(study: Study) -> Table:
    by_env = grouped(study.runs, lambda run: run.env)

    def common(value_of: Callable[[Run], Any]) -> Callable[[str], Any]:
        return lambda env: one_or_all(map(value_of, by_env[env]))

    def dimension(name: str) -> Callable[[str], Any]:
        return common(lambda run: getattr(run.record.experiment_dimensions, name) or None)

    known = catalogue.entries().get
    version = Column("version", "Version", of=common(lambda run: run.record.versions.env))
    columns = (
        replace(ENV, of=title_of),
        Column("family", "Family", of=lambda env: family_title(family_of(env))),
        Column("id", "Suite id", of=str),
        version,
        Column("spaces", "Obs./action", of=lambda env: (e := known(env)) and f"{e.observation}/{e.action}"),
        Column("demand", "Demand", of=demand_of),
        Column(
            "steps",
            "Longest episode (steps)",
            "integer",
            of=lambda env: (e := known(env)) and e.max_episode_steps,
        ),
        Column(
            "budget", "Budget", "integer", note="Train episodes of a run.", of=common(lambda run: run.budget)
        ),
        Column("submit", "Episodes a submit", note="Fewest to most.", of=common(lambda run: run.submit_size)),
        Column("validation", "Validation cases", "integer", of=dimension("n_validation")),
        Column("heldout", "Held-out cases", "integer", of=dimension("n_heldout")),
        Column(
            "scope", "Policy scope", note="How long one policy object lives.", of=dimension("policy_scope")
        ),
    )
    table = tabulated(
        ordered_environments(by_env),
        columns,
        name="environments",
        title="Environments",
        caption="What was played: cases of a run's hidden splits, and the train episodes that it could spend.",
    )
    return replace(table, columns=(*(column for column in columns if column is not version), version))


_FEEDBACK = (
    Column("env", "Environment", of=lambda one: title_of(one[0].env)),
    Column("entry", "Agent", of=lambda one: one[0].entry),
    Column("run", "Run", of=lambda one: _short(one[0].name)),
    Column("submit", "Submit", of=lambda one: one[1].submit.label),
    Column("before", "Budget before", "integer", of=lambda one: one[1].submit.consumed_before),
    Column("after", "Budget after", "integer", of=lambda one: one[1].submit.consumed),
    Column("read", "Evidence read", of=lambda one: ", ".join(getattr(one[1].evidence, "read", ())) or None),
    Column("said", "The agent's own words", of=lambda one: _quote(one[1].evidence)),
    Column("status", "Status", of=lambda one: one[1].submit.status),
    Column("edit", "Edit", of=lambda one: getattr(one[1].transition, "edit", None)),
    Column("changed_lines", "Changed lines", "integer", of=lambda one: one[1].submit.changed_lines),
    Column("visible", "Visible mean", "number", of=lambda one: one[1].submit.mean_return),
    Column("validation", "Validation mean", "number", of=lambda one: one[1].submit.val_mean),
    Column(
        "best", "New validation best", of=lambda one: (t := one[1].transition) and ("yes" if t.hit else "no")
    ),
    Column("selected", "Selected", of=lambda one: "yes" if one[1].submit is one[0].selected else None),
)


def submits_of(trace: Trace) -> list[dict[str, Any]]:
    """A run's rows of the table of feedback use."""
    return rows_of([(trace.run, row) for row in trace.rows], _FEEDBACK)


def _quote(evidence: Evidence | None) -> str:
    quote = " ".join(evidence.attribution.split()) if evidence is not None else ""
    return quote if len(quote) <= _MAX_QUOTE else quote[: _MAX_QUOTE - 1] + "…"


def feedback_use(rows: Iterable[dict[str, Any]]) -> Table:
    """Every submit of every run (`submits_of`). Too long for a page; each run has a page of its own."""
    return Table(
        name="feedback_use",
        title="Feedback use",
        caption=(
            "One row a submit: what the agent had read and said since the submit before, how the policy changed, and"
            " what came of it. Budget: train episodes consumed before and after. Validation is hidden from agents."
        ),
        columns=_FEEDBACK,
        rows=tuple(rows),
    )


def _audit_row(signals: AuditSignals) -> dict[str, Any]:
    run, record = signals.run, signals.run.record
    selected = record.outcome.best_submit_index

    def recorded(value: Any) -> Any:
        return None if run.is_published else value

    return {
        "run": _short(run.name),
        "entry": run.entry,
        "env": title_of(run.env),
        "accepted": len(run.submits),
        "rejected": recorded(len(record.rejected_submits)),
        "not_ok": signals.not_ok,
        "invalid_rate": signals.invalid_rate,
        "repaired_rate": signals.repaired_rate,
        "budget": run.budget,
        "budget_used": run.submits[-1].consumed if run.submits else 0,
        "episodes_per_submit": signals.episodes_per_submit,
        "failed_episodes": signals.failed_episodes,
        "score_drops": signals.score_drops,
        "selected_index": selected,
        "complexity_growth": signals.complexity_growth,
        "retries": recorded(record.agent.retries),
        "turns": recorded(record.agent.turns),
        "wall_s": record.timing.wall_time_seconds,
        **{phase: recorded(getattr(record.timing, phase)) for phase in PHASES},
        "secret_splits": record.versions.data_secret,
        "jail": record.jail,
        "hidden_isolation": record.hidden_isolation,
        "hidden_cases": record.experiment_dimensions.hidden_cases,
        "simulation": record.experiment_dimensions.simulation,
        "simulator_flags": None if run.simulation_allowed else len(run.simulator_flags),
        "signals": len(run.signals),
        "selected": None if selected is None else f"s{selected:03d}",
        "splits": "secret" if record.versions.data_secret else "public",
    }


def _audit(study: Study) -> Table:
    flags = "Places in its code that look like a simulator: a signal to read, never a verdict."
    repaired = "Share of the train steps whose action was outside the action space."
    splits = "`public`: of case files or a public seed that anybody may know."
    return Table(
        name="audit",
        title="Audit signals",
        caption=(
            "One row a run. Invalid submits: accepted ones that are not ok, of all accepted. Repaired actions: share of"
            " the train steps whose action was outside the action space; a dash for runs of earlier versions. Score"
            " drops: score-bearing submits whose validation mean is below the one before. Growth: AST nodes of the"
            " selected policy over those of the first. Wall time by phase, in seconds; phases may overlap."
        ),
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
            Column("simulator_flags", "Simulator flags", "integer", note=flags),
            Column(
                "signals",
                "Signals",
                "integer",
                note="Places in its log and code that deserve a look: no verdict.",
            ),
            *(
                Column(phase, f"{phase.removesuffix('_s').capitalize()} (s)", "number", digits=0)
                for phase in ("wall_s", *PHASES)
            ),
        ),
        rows=tuple(map(_audit_row, study.audit)),
        runs=tuple(signals.run.name for signals in study.audit),
    )


_SIMULATORS = (
    "A signal to read, never a verdict: imports and installations of a simulator, and code with a loop and several"
    " numbers of the environment's dynamics. Simulators that an agent writes itself are seldom found. Runs whose rules"
    " allow simulation are left out."
)
_SIGNALS = (
    "Signals to read, never verdicts: commands that reach for the network, for files outside the workspace or for a"
    " simulator, policies with tables keyed by hashes of observations or by case, and policies that hold recorded train"
    " actions. Honest agents can raise a signal, and an agent can hide from the search."
)


def _evidence(signals: list[tuple[Run, Signal]], name: str, title: str, caption: str) -> Table:
    return tabulated(
        signals,
        (
            *_FEEDBACK[:3],
            Column("signal", "Signal", of=lambda one: TITLES[one[1].kind]),
            Column("file", "File", of=lambda one: one[1].place),
            Column("submits", "Submits", of=lambda one: submits_text(one[1].submits) or None),
            Column("reason", "Why", of=lambda one: one[1].reason),
            Column("quote", "Evidence", of=lambda one: one[1].quote[:_MAX_QUOTE]),
        ),
        run=lambda one: one[0].name,
        name=name,
        title=title,
        caption=caption,
    )


def submits_text(indices: Iterable[int]) -> str:
    """Submit labels such as `s000–s003, s007`: neighbours as a range."""
    spans: list[list[int]] = []
    for index in sorted(indices):
        if spans and index == spans[-1][1] + 1:
            spans[-1][1] = index
        else:
            spans.append([index, index])
    return ", ".join(f"s{a:03d}" if a == b else f"s{a:03d}–s{b:03d}" for a, b in spans)


_MISSING: tuple[tuple[str, str, Callable[[Run], bool]], ...] = (
    (
        "Normalised performance",
        "the random reference on the held-out cases",
        lambda run: run.record.outcome.random_reference is None,
    ),
    (
        "Score evolution",
        "the random reference: the scale begins at the lowest first score instead",
        lambda run: run.record.outcome.random_reference is None,
    ),
    ("Score evolution", "validation means, so no curve", lambda run: not run.record.outcome.val_scores),
    ("Edit types, edit size", "validation means, so no hits", lambda run: not run.record.outcome.val_scores),
    (
        "Realised structure",
        "the selected policy's source",
        lambda run: run.selected is None or run.selected.source is None,
    ),
    ("Tokens and cost", "tokens and cost", lambda run: run.record.agent.tokens is None),
    ("Audit signals", "refused requests, turns, retries, the phases of the wall time", lambda run: True),
    ("Agents", "harness, version, settings, jail, hidden isolation", lambda run: True),
    ("Environments", "the bounds of a submit, the number of validation cases", lambda run: True),
)
"""Table, the information that it lacks for runs of the published software, and a test for affected runs."""


def _missing(study: Study) -> Table:
    """The information missing from the published software's run directories, by table."""
    runs = [run for run in study.runs if run.is_published]
    counts = [(table, what, sum(map(lacks, runs))) for table, what, lacks in _MISSING]
    return tabulated(
        [each for each in counts if each[2]],
        (
            Column("table", "Table", of=itemgetter(0)),
            Column("what", "Missing value", of=itemgetter(1)),
            Column("runs", "Runs", "integer", of=itemgetter(2)),
        ),
        name="not_told",
        title="Missing values",
        caption="Values that run directories of the published software lack, by table. They are left empty.",
    )
