"""The report's pages as text: contents and wording. Markup is in `templates/`; `report` writes the files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from markupsafe import Markup, escape

from evopolicy_common.records.policies.submits import read_submits
from evopolicy_common.records.run_record import Replay
from evopolicy_common.records.words import in_words
from evopolicy_common.terminal import number
from evopolicy_results.behaviour.trace import Trace, diff, sources
from evopolicy_results.figures.plot import Plot
from evopolicy_results.html import notice, section, visible
from evopolicy_results.html.rendering import page
from evopolicy_results.html.run_page import run_view, submit_rows
from evopolicy_results.reading.environments import grouped, title_of
from evopolicy_results.reading.records import Run
from evopolicy_results.studies.palette import Look
from evopolicy_results.studies.study import Study
from evopolicy_results.tables.table import Column, Table, shown

_FILTER_FROM = 9
"""Number of rows from which a table has a filter."""
_RANKS_FROM = 4
"""Number of environments from which a report begins with rank scores; with fewer, returns say more."""
_LONG = 60
"""Number of characters from which a cell's text is broken into lines."""
FORMS = (("CSV", "csv"), ("Markdown", "md"), ("LaTeX", "tex"))
"""File forms of a table, with their suffixes."""


class _Section(NamedTuple):
    ident: str
    nav: str
    title: str = ""
    text: str = ""
    figures: str = ""
    tables: str = ""
    """Names of figures and of tables. `name_*` has one for each suite, `name_+` one for each suite with means
    over environments. All names between two semicolons are of the first suite, then of the next."""


_SECTIONS = (
    _Section("returns", "Returns", "Held-out returns", tables="heldout_*; cells_*"),
    _Section("leaderboard", "Leaderboard", figures="rank_scores_+", tables="leaderboard_+ incomplete_+"),
    _Section(
        "statistics",
        "Statistics",
        "How sure the scores are",
        "Intervals are at 95 %. Each table says over what: the cases of one run, or runs and cases. No verdict"
        " contradicts the interval beside it; the exact test of runs and the correction for many pairs can only"
        " withhold one.",
        "profiles_*",
        "resolution_*; aggregates_+ improvement_+; pairs_* generalisation_*",
    ),
    _Section("starts", "Runs from one state", tables="starts"),
    _Section(
        "worlds",
        "Worlds",
        "Environments and their worlds",
        "A world is the environment with altered rules. A lower score there shows knowledge that these rules do not"
        " confirm, or too little exploration: compare with agents that know nothing of the environments.",
        "worlds",
        "worlds",
    ),
    _Section("evolution", "Score evolution", figures="score_evolution_*", tables="evolution"),
    _Section(
        "demand",
        "Task demand",
        "Performance by task demand",
        "Synthesis-dominant tasks need machinery (perception, memory, planning); tuning-dominant ones mostly need the"
        " right constants. This is one way to read the results, not a classification of tasks.",
        "normalised_*",
        "normalised_+",
    ),
    _Section("edits", "Edits", "What edits do", "", "edit_hits edit_size", "edit_types edit_sizes"),
    _Section("timelines", "Timelines", "Code-phase timelines"),
    _Section("structure", "Structure", "Realised structure", "", "structure", "structure"),
    _Section("cost", "Cost and audit", "", "", "tokens wall_time", "tokens audit"),
    _Section(
        "feedback",
        "Feedback use",
        "",
        "Each run has a page: what its agent read and said before every submit, what it changed, and what came of it,"
        " with all checkpoints and their differences.",
    ),
    _Section("replays", "Replays"),
    _Section("setup", "Setup", tables="agents environments not_told"),
    _Section("left-out", "Left out"),
)


def index_page(
    study: Study,
    *,
    title: str | None,
    looks: Mapping[str, Look],
    tables: Sequence[Table],
    figures: Sequence[Plot],
    trace_links: Mapping[str, str],
    replay_links: Mapping[str, str],
) -> str:
    """`index.html`: every section with content. Without a `title` it names the suites."""
    n_envs = len({env for suite in study.suites for env in suite.table.environments})
    folded = ("pairs_", "generalisation_", "cells_")[: 3 if n_envs >= _RANKS_FROM else 2]
    views = {
        table.name: {**table_view(table, trace_links), "folded": table.name.startswith(folded)}
        for table in tables
    }
    by_name = {figure.name: figure for figure in figures}
    timelines = [figure for figure in figures if figure.name.startswith("timeline_")]

    def named(names: str) -> list[str]:
        return [
            name[:-1] + suite.name if name.endswith(("_*", "_+")) else name
            for group in names.split(";")
            for suite in study.suites
            for name in group.split()
            if suite.is_ranked or not name.endswith("_+")
        ]

    parts: dict[str, dict[str, Any]] = {
        each.ident: {
            "figures": [by_name[name] for name in dict.fromkeys(named(each.figures)) if name in by_name],
            "tables": [views[name] for name in dict.fromkeys(named(each.tables)) if name in views],
            "texts": [each.text] if each.text else [],
        }
        for each in _SECTIONS
    }
    envs_of_timelines = [figure.data[0]["env"] for figure in timelines]
    parts["timelines"] = {"figures": timelines, "picker": [(env, title_of(env)) for env in envs_of_timelines]}
    if trace_links:
        label = "All submits in one table"
        links = [(f"{label} ({form})", f"tables/feedback_use.{suffix}") for form, suffix in FORMS]
        parts["feedback"] |= {"tables": [views["runs"]], "links": links}
    videos = "Videos of the selected checkpoints' episodes, agents side by side."
    none = "None of these runs has recorded episodes of its selected checkpoint."
    links = [(title_of(env), href) for env, href in replay_links.items()]
    parts["replays"] = {"texts": [videos if links else none], "links": links}
    nothing = "Nothing: every run folder that was found is in this report."
    parts["left-out"] = {"tables": [views["left_out"]]} if study.left_out else {"texts": [nothing]}
    first = ["returns", "evolution"]
    if n_envs >= _RANKS_FROM:
        parts["leaderboard"]["tables"] += parts.pop("returns")["tables"]
        first = []
    sections = [
        section(each.ident, each.nav, title=each.title, **parts[each.ident])
        for each in sorted(_SECTIONS, key=lambda one: one.ident not in first)
        if each.ident in parts
    ]
    n_started = sum(run.record.start is not None for run in study.runs)
    counts = {
        "agents": len(study.entries),
        "environments": n_envs,
        "runs": len(study.runs),
        **({"of these from a submit": n_started} if n_started else {}),
        "submits": sum(len(run.submits) for run in study.runs),
    }
    facts = [(noun if n != 1 else noun.removesuffix("s"), n) for noun, n in counts.items()]
    return page(
        "index",
        title=title or ", ".join(suite.title for suite in study.suites) + ": policy evolution report",
        lead="Agents evolve an executable policy under a budget of train episodes; the checkpoint that hidden"
        " validation selects is scored on hidden held-out cases.",
        facts=[*facts, ("left out", len(study.left_out))],
        looks=looks,
        notices=_notices(study),
        sections=[
            each
            for each in sections
            if each["figures"] or each["tables"] or each["links"] or each["id"] in ("replays", "left-out")
        ],
        footer="Scores rank held-out means within each environment; everything below the leaderboard is a diagnostic"
        " and no part of the score. Made by evopolicy report.",
        data="report.json",
    )


_NOTICES: tuple[tuple[Callable[[Run], bool], str], ...] = (
    (lambda run: not run.record.versions.data_secret,
     "played public splits, of case files or a public seed: agents and models may know the hidden cases."),
    (lambda run: run.simulation_allowed,
     "let their agent simulate, or are from before there was a rule against it."),
    (lambda run: run.record.line.jail == "none", "had no jail around their agent, or that of a run they start from."),
    (lambda run: run.record.hidden_isolation == "unknown",
     "do not tell whether hidden episodes and agents shared a kernel: they are from before it was recorded."),
    (lambda run: run.record.hidden_isolation == "shared",
     "were played while hidden episodes and agents could share a kernel (--hidden-isolation off)."),
    (lambda run: run.record.hidden_isolation == "waived",
     "had agents whose place the operator vouched for (--agent-host elsewhere)."),
    (lambda run: run.record.experiment_dimensions.hidden_cases == "per_run",
     "had hidden cases of their own: no two scores are on the same cases, so differences between runs cannot be"
     " paired by case."),
)  # fmt: skip
"""Remarks on runs, each after the condition under which it holds of a run."""


def _notices(study: Study) -> list[dict[str, Any]]:
    notices = [notice(study.post_hoc)] if study.post_hoc else []
    if study.mixtures:
        title = "These runs are no fair comparison: they were mixed on purpose, and differ in"
        notices.append(notice(title, map(str, study.mixtures)))
    counts = [(sum(map(holds, study.runs)), text) for holds, text in _NOTICES]
    return notices + [notice(f"{n} of {len(study.runs)} runs {text}") for n, text in counts if n]


def table_view(table: Table, pages: Mapping[str, str] = {}) -> dict[str, Any]:
    """The table for a page, without columns of no values. `pages`: those of runs, by their names."""
    columns = [
        c for c in table.columns if not table.rows or any(row.get(c.key) is not None for row in table.rows)
    ]
    titles = [escape(visible(column.title)).replace(" /", Markup("&nbsp;/")) for column in columns]
    runs = table.runs or [""] * len(table.rows)
    return {
        "id": table.name.replace("_", "-") + "-table",
        "title": table.title,
        "caption": table.caption,
        "files": [(label, f"tables/{table.name}.{suffix}") for label, suffix in FORMS],
        "filter": len(table.rows) >= _FILTER_FROM,
        "folded": False,
        "columns": [
            {"title": title.replace("-", "\u2011"), "numeric": column.kind != "text", "note": column.note}
            for column, title in zip(columns, titles, strict=True)
        ],
        "rows": [
            [
                _cell(column, row.get(column.key), table.marks.get((number, column.key), 0), pages.get(run))
                for column in columns
            ]
            for number, (row, run) in enumerate(zip(table.rows, runs, strict=True))
        ],
    }


def _cell(column: Column, value: Any, mark: int, page_of_run: str | None) -> dict[str, Any]:
    numeric = column.kind != "text"
    is_long = not numeric and len(str(value)) > _LONG
    classes = {"n": numeric, "first": mark == 1, "second": mark == 2}
    classes |= {"none": value is None and not numeric, "long": is_long}
    return {
        "text": shown(value, column),
        "value": ("" if value is None else value) if numeric else None,
        "cls": " ".join(name for name, holds in classes.items() if holds),
        "href": page_of_run if column.key == "run" else None,
        "entry": value if column.key == "entry" else None,
    }


def run_title(run: Run) -> str:
    return f"{run.entry} on {title_of(run.env)}, {run.record.exp_id}"


def trace_page(
    trace: Trace,
    *,
    look: Look | None,
    image_links: Mapping[int, Sequence[tuple[str, str]]],
    videos: Mapping[int, str],
    beside: Sequence[tuple[str, Look | None, str]] = (),
) -> str:
    """One run's page. By submit index, `image_links` has (name, path relative to the page) of its copied images, and
    `videos` the path of its copied feedback video. `beside` lists (agent, look, page) of other agents on the same
    environment."""
    run, record = trace.run, trace.run.record
    outcome, best = record.outcome, record.outcome.best_submit_index
    closed = in_words(outcome.closed_reason)
    used = run.submits[-1].consumed if run.submits else 0
    rows = submit_rows(
        run.submits,
        {one.index: one.summary for one in read_submits(run.path, record.artifacts)}
        if not run.is_published
        else {},
        traced={row.submit.index: row for row in trace.rows},
        folder=run.path,
        selected=best,
        may_show=True,
        href="#s{:03d}-source",
        images=image_links,
        videos=videos,
    )
    view = run_view(
        rows,
        entry=run.entry,
        env=run.env,
        look=look,
        facts=[
            (
                "held-out mean" if run.rescore is None else f"post hoc mean, {run.rescore.name}",
                number(run.score),
            ),
            ("selected", "–" if best is None else f"s{best:03d}"),
            ("submits", len(run.submits)),
            ("episodes used", f"{used} of {run.budget}"),
            ("rejected requests", "–" if run.is_published else len(record.rejected_submits)),
        ],
        budget=run.budget,
        trace=trace,
    )
    lead = [f"Run {record.exp_id}", f"repeat {record.repeat}", f"harness {run.harness}"]
    lead += [f"policy scope {record.experiment_dimensions.policy_scope}"]
    return page(
        "run",
        frame="base.html.j2",
        view=view,
        title=run_title(run),
        back="../index.html",
        lead=[*lead, *([f"ended by: {closed}"] if closed else [])],
        beside=beside,
        unplaced=trace.unplaced,
        checkpoints=_checkpoints(trace),
        replays=[],
    )


def _checkpoints(trace: Trace) -> dict[str, dict[str, Any]]:
    """By label: the first checkpoint with the same files, and what changed since the one before."""
    out: dict[str, dict[str, Any]] = {}
    previous: dict[str, str] | None = None
    labels: dict[str, str] = {}
    for row in trace.rows:
        if texts := sources(trace.run, row.submit):
            same_as = labels.setdefault(repr(sorted(texts.items())), row.submit.label)
            diffs = [] if previous is None else diff(previous, texts)
            edit = "" if row.transition is None else row.transition.edit
            out[row.submit.label] = {"edit": edit, "same_as": same_as, "diffs": diffs, "texts": texts}
            previous = texts
    return out


class PlayedEpisode(NamedTuple):
    """A recorded episode of one run, with the parts of it that were copied into the report."""

    run: Run
    replay: Replay
    video: str | None
    """Path of the copy, relative to the page; None when the recording is missing."""
    strip: str | None


def replays_page(env: str, episodes: Iterable[PlayedEpisode], looks: Mapping[str, Look]) -> str:
    """One environment's recordings: one group per case, with one card per run."""

    def case(played: PlayedEpisode) -> str:
        split = "Held-out" if played.replay.split == "heldout" else played.replay.split.capitalize()
        return f"{split} case {played.replay.episode}"

    def place(played: PlayedEpisode) -> tuple[str, int, str, int]:
        replay, run = played.replay, played.run
        return replay.split, replay.episode, run.entry.casefold(), run.record.repeat

    groups = grouped(sorted(episodes, key=place), case)
    return page("replays", title=f"Replays: {title_of(env)}", env=env, looks=looks, groups=groups)
