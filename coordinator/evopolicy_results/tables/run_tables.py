"""The report's tables about the runs: setups of agents and environments, the runs, their audit signals, their submits
with the preceding feedback, and the omitted runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from evopolicy_common import catalogue
from evopolicy_results.behaviour.edits import demand_of
from evopolicy_results.behaviour.trace import Trace, TraceRow
from evopolicy_results.reading.environments import family_of, family_title, ordered_environments, title_of
from evopolicy_results.reading.records import Run, path_text
from evopolicy_results.scan.signals import TITLES, Signal
from evopolicy_results.studies.study import Study
from evopolicy_results.tables.table import Column, Table, tabulated

ENTRY = Column("entry", "Agent")
HARNESS = Column("harness", "Harness")
ENV = Column("env", "Environment", of=lambda record: title_of(record.env))
RUN = Column("run", "Run", of=lambda record: _short(record.run))
RUNS = Column("runs", "Runs", "integer", of=lambda record: record.n_runs)

_COUNTERS = frozenset({"reprompted", "paused_s", "requests_failed", "resumed"})
"""Counters of a run's course that a harness stores among its settings; they are not settings."""
_MAX_QUOTE = 240

LinkOf = Callable[[str], str]
"""Returns the page about a run by its name, or the empty string."""


def no_link(run: str) -> str:
    return ""


def tables_of_runs(study: Study, link_of: LinkOf) -> list[Table]:
    return [
        _runs(study, link_of),
        _audit(study, link_of),
        _signals(study, link_of),
        _simulators(study, link_of),
        _agents(study),
        _environments(study),
        _missing(study),
        _left_out(study),
    ]


def one_or_all(values: Iterable[Any]) -> Any:
    """The common value of all, or `A or B` if different runs were mixed."""
    found = list(dict.fromkeys(values))
    return found[0] if len(found) == 1 else " or ".join(str(value) for value in found)


def _short(run: str) -> str:
    """The experiment in a run's name: agent and environment have columns of their own."""
    return run.rsplit(" / ", 1)[-1]


def _runs(study: Study, link_of: LinkOf) -> Table:
    return tabulated(
        study.runs,
        (
            ENV,
            ENTRY,
            Column("run", "Run", of=lambda run: _short(run.name)),
            Column("submits", "Submits", "integer", of=lambda run: len(run.submits)),
            Column("score", "Held-out mean", "number"),
            Column(
                "journal",
                "Journal",
                note=(
                    "Entry with the run's result, and the journal's head there. A head that you noted earlier shows"
                    " whether the journal was rewritten."
                ),
                of=_journal,
            ),
        ),
        link=lambda run: link_of(run.name),
        name="runs",
        title="Runs",
        caption="Open a run for its feedback use, timeline, checkpoints and differences.",
    )


def _journal(run: Run) -> str | None:
    """Position of the run's result in the coordinator's journal; None for runs from before the journal existed."""
    place = run.record.committed
    return None if place is None or place.ended is None else f"{place.ended} {place.ended_head[:16]}"


def _agents(study: Study) -> Table:
    """One row per setup of an entry: several rows show that its runs differ."""
    counts: dict[tuple[str, ...], int] = {}
    for run in study.runs:
        agent = run.record.agent
        setup = (
            run.entry,
            run.harness,
            agent.cli_version or "",
            agent.model_string or "",
            _settings(run),
            run.record.jail,
            run.record.hidden_isolation,
        )
        counts[setup] = counts.get(setup, 0) + 1
    keys = ("entry", "harness", "cli_version", "model", "settings", "jail", "hidden_isolation")
    rows = [
        {**{key: value or None for key, value in zip(keys, setup, strict=True)}, "runs": n}
        for setup, n in sorted(counts.items(), key=lambda item: (item[0][0].casefold(), item[0]))
    ]
    return Table(
        name="agents",
        title="Agents",
        caption=(
            "How each agent was set up, as its run directories tell; an agent with several rows was not the same in all"
            " of its runs."
        ),
        columns=(
            ENTRY,
            HARNESS,
            Column("cli_version", "Version", note="Of the harness's program."),
            Column("model", "Model string"),
            Column("settings", "Settings"),
            Column("jail", "Jail"),
            Column(
                "hidden_isolation",
                "Hidden isolation",
                note="exclusive: hidden episodes and agents never shared a kernel.",
            ),
            Column("runs", "Runs", "integer"),
        ),
        rows=tuple(rows),
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
    by_env: dict[str, list[Run]] = {}
    for run in study.runs:
        by_env.setdefault(run.env, []).append(run)

    def common(runs: list[Run], value_of: Callable[[Run], Any]) -> Any:
        return one_or_all(value_of(run) for run in runs)

    rows: list[dict[str, Any]] = []
    for env in ordered_environments(by_env):
        runs, known = by_env[env], catalogue.entries().get(env)
        rows.append(
            {
                "env": title_of(env),
                "family": family_title(family_of(env)),
                "id": env,
                "version": common(runs, lambda run: run.record.versions.env),
                "spaces": f"{known.observation}/{known.action}" if known is not None else None,
                "demand": demand_of(env),
                "steps": known.max_episode_steps if known is not None else None,
                "budget": common(runs, lambda run: run.budget),
                "submit": common(runs, lambda run: run.submit_size),
                "validation": common(runs, lambda run: run.record.experiment_dimensions.n_validation or None),
                "heldout": common(runs, lambda run: run.record.experiment_dimensions.n_heldout or None),
                "scope": common(runs, lambda run: run.record.experiment_dimensions.policy_scope),
            }
        )
    return Table(
        name="environments",
        title="Environments",
        caption="What was played: cases of a run's hidden splits, and the train episodes that it could spend.",
        columns=(
            ENV,
            Column("family", "Family"),
            Column("id", "Suite id"),
            Column("spaces", "Obs./action"),
            Column("demand", "Demand"),
            Column("steps", "Longest episode (steps)", "integer"),
            Column("budget", "Budget", "integer", note="Train episodes of a run."),
            Column("submit", "Episodes a submit", note="Fewest to most."),
            Column("validation", "Validation cases", "integer"),
            Column("heldout", "Held-out cases", "integer"),
            Column("scope", "Policy scope", note="How long one policy object lives."),
            Column("version", "Version"),
        ),
        rows=tuple(rows),
    )


def submits_of(trace: Trace) -> list[dict[str, Any]]:
    """A run's rows of the table of feedback use."""
    run = trace.run
    return [
        {
            "env": title_of(run.env),
            "entry": run.entry,
            "run": _short(run.name),
            **_submit(row),
            "selected": "yes" if row.submit.index == run.record.outcome.best_submit_index else None,
        }
        for row in trace.rows
    ]


def _submit(row: TraceRow) -> dict[str, Any]:
    submit, transition, evidence = row.submit, row.transition, row.evidence
    quote = " ".join(evidence.attribution.split()) if evidence is not None else ""
    return {
        "submit": submit.label,
        "before": submit.consumed_before,
        "after": submit.consumed,
        "read": ", ".join(evidence.read) or None if evidence is not None else None,
        "said": quote if len(quote) <= _MAX_QUOTE else quote[: _MAX_QUOTE - 1] + "…",
        "status": submit.status,
        "edit": transition.edit if transition is not None else None,
        "changed_lines": submit.changed_lines,
        "visible": submit.mean_return,
        "validation": submit.val_mean,
        "best": ("yes" if transition.hit else "no") if transition is not None else None,
    }


def feedback_use(rows: Iterable[dict[str, Any]]) -> Table:
    """Every submit of every run (`submits_of`). Too long for a page; each run has a page of its own."""
    return Table(
        name="feedback_use",
        title="Feedback use",
        caption=(
            "One row a submit: what the agent had read and said since the submit before, how the policy changed, and"
            " what came of it. Budget: train episodes consumed before and after. Validation is hidden from agents."
        ),
        columns=(
            ENV,
            ENTRY,
            RUN,
            Column("submit", "Submit"),
            Column("before", "Budget before", "integer"),
            Column("after", "Budget after", "integer"),
            Column("read", "Evidence read"),
            Column("said", "The agent's own words"),
            Column("status", "Status"),
            Column("edit", "Edit"),
            Column("changed_lines", "Changed lines", "integer"),
            Column("visible", "Visible mean", "number"),
            Column("validation", "Validation mean", "number"),
            Column("best", "New validation best"),
            Column("selected", "Selected"),
        ),
        rows=tuple(rows),
    )


def _audit(study: Study, link_of: LinkOf) -> Table:
    rows: list[dict[str, Any]] = []
    for audited in study.audit:
        row = {key: getattr(audited, key) for key in audited.__struct_fields__}
        selected = audited.selected_index
        row |= {
            "env": title_of(audited.env),
            "run": _short(audited.run),
            "selected": None if selected is None else f"s{selected:03d}",
            "splits": "secret" if audited.secret_splits else "public",
        }
        rows.append(row)

    def seconds(key: str, title: str) -> Column:
        return Column(key, f"{title} (s)", "number", digits=0)

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
            Column(
                "repaired_rate",
                "Repaired actions",
                "number",
                digits=4,
                below=True,
                note="Share of the train steps whose action was outside the action space.",
            ),
            Column("budget_used", "Budget used", "integer"),
            Column("episodes_per_submit", "Episodes / submit", "number", digits=1),
            Column("failed_episodes", "Failed episodes", "integer"),
            Column("score_drops", "Score drops", "integer"),
            Column("selected", "Selected"),
            Column("complexity_growth", "Growth (×)", "number", digits=2),
            Column("turns", "Turns", "integer"),
            Column("retries", "Retries", "integer"),
            Column(
                "splits", "Splits", note="`public`: of case files or a public seed that anybody may know."
            ),
            Column("simulation", "Simulation", note="Whether the run's rules let the agent simulate."),
            Column(
                "simulator_flags",
                "Simulator flags",
                "integer",
                note="Places in its code that look like a simulator: a signal to read, never a verdict.",
            ),
            Column(
                "signals",
                "Signals",
                "integer",
                note="Places in its log and code that deserve a look: no verdict.",
            ),
            seconds("wall_s", "Wall"),
            seconds("agent_s", "Agent"),
            seconds("queue_s", "Queue"),
            seconds("rollout_s", "Rollout"),
            seconds("feedback_s", "Feedback"),
            seconds("finalise_s", "Finalise"),
        ),
        rows=tuple(rows),
        links={i: link for i, audited in enumerate(study.audit) if (link := link_of(audited.run))},
    )


def _simulators(study: Study, link_of: LinkOf) -> Table:
    return _evidence(
        [(run, each) for run in study.runs for each in run.simulator_flags],
        link_of,
        name="simulator_flags",
        title="Code that looks like a simulator",
        caption=(
            "A signal to read, never a verdict: imports and installations of a simulator, and code with a loop and"
            " several numbers of the environment's dynamics. Simulators that an agent writes itself are seldom found."
            " Runs whose rules allow simulation are left out."
        ),
    )


def _signals(study: Study, link_of: LinkOf) -> Table:
    return _evidence(
        [(run, each) for run in study.runs for each in run.signals],
        link_of,
        name="signals",
        title="What deserves a look",
        caption=(
            "Signals to read, never verdicts: commands that reach for the network, for files outside the workspace or"
            " for a simulator, policies with tables keyed by hashes of observations or by case, and policies that hold"
            " recorded train actions. Honest agents can raise a signal, and an agent can hide from the search."
        ),
    )


def _evidence(
    found: list[tuple[Run, Signal]], link_of: LinkOf, *, name: str, title: str, caption: str
) -> Table:
    return tabulated(
        found,
        (
            Column("env", "Environment", of=lambda one: title_of(one[0].env)),
            Column("entry", "Agent", of=lambda one: one[0].entry),
            Column("run", "Run", of=lambda one: _short(one[0].name)),
            Column("signal", "Signal", of=lambda one: TITLES[one[1].kind]),
            Column("file", "File", of=lambda one: one[1].place),
            Column("submits", "Submits", of=lambda one: submits_text(one[1].submits) or None),
            Column("reason", "Why", of=lambda one: one[1].reason),
            Column("quote", "Evidence", of=lambda one: one[1].quote[:_MAX_QUOTE]),
        ),
        link=lambda one: link_of(one[0].name),
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


def _no_reference(run: Run) -> bool:
    return run.record.outcome.random_reference is None


def _no_validation(run: Run) -> bool:
    return not run.record.outcome.val_scores


_MISSING: tuple[tuple[str, str, Callable[[Run], bool]], ...] = (
    ("Normalised performance", "the random reference on the held-out cases", _no_reference),
    (
        "Score evolution",
        "the random reference: the scale begins at the lowest first score instead",
        _no_reference,
    ),
    ("Score evolution", "validation means, so no curve", _no_validation),
    ("Edit types, edit size", "validation means, so no hits", _no_validation),
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
    return Table(
        name="not_told",
        title="Missing values",
        caption="Values that run directories of the published software lack, by table. They are left empty.",
        columns=(
            Column("table", "Table"),
            Column("what", "Missing value"),
            Column("runs", "Runs", "integer"),
        ),
        rows=tuple({"table": table, "what": what, "runs": n} for table, what, n in counts if n),
    )


def _left_out(study: Study) -> Table:
    return tabulated(
        study.left_out,
        (Column("path", "Folder", of=lambda item: path_text(item.path)), Column("reason", "Reason")),
        name="left_out",
        title="Left out",
        caption="Folders that are no complete run, and why. They are in no table and no figure.",
    )
