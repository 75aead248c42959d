"""The report's pages as text: contents and wording. Markup is in `templates/`; `report` writes the files."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from typing import Any, NamedTuple

import msgspec
from markupsafe import Markup, escape

from evopolicy_common.records.run_record import Replay
from evopolicy_common.records.words import in_words
from evopolicy_common.terminal import number
from evopolicy_results.behaviour.trace import Trace, diff, sources
from evopolicy_results.figures.plot import Plot
from evopolicy_results.html import Notice, page, section, visible
from evopolicy_results.html.run_page import run_view
from evopolicy_results.reading.environments import grouped, title_of
from evopolicy_results.reading.records import PastRun
from evopolicy_results.studies.answers import answers_of
from evopolicy_results.studies.palette import Look
from evopolicy_results.studies.study import Study
from evopolicy_results.tables.report_tables import MEANS
from evopolicy_results.tables.table import Column, Table, texts_of

_FILTER_FROM = 9
"""Number of rows from which a table has a filter."""
_ROWS = 20
"""Rows of a table that show before it is asked for all."""
_LONG = 60
"""Number of characters from which a cell's text is broken into lines."""
FORMS = (("CSV", "csv"), ("Markdown", "md"), ("LaTeX", "tex"))
"""File forms of a table, with their suffixes."""


class _Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    ident: str
    nav: str
    ask: str
    """The reader's question that it answers."""
    figures: str = ""
    tables: str = ""
    """Names of figures and of tables. `name_*` has one for each suite."""
    text: str = ""


_PLAN = files("evopolicy_results.html").joinpath("templates", "sections.toml").read_text("utf-8")
_SECTIONS = msgspec.convert(tomllib.loads(_PLAN)["section"], list[_Section])


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
    is_ranked = any(suite.is_ranked for suite in study.suites)
    shown_tables = [table for table in tables if is_ranked or table.name not in MEANS]
    views = {table.name: table_view(table, trace_links) for table in shown_tables}
    answers = answers_of(study)
    by_name = {figure.name: figure for figure in figures}
    timelines = [figure for figure in figures if figure.name.startswith("timeline_")]

    def named(names: str) -> list[str]:
        suites = [suite.name for suite in study.suites]
        return [
            name
            for each in names.split()
            for name in ([each[:-1] + suite for suite in suites] if "*" in each else [each])
        ]

    parts: dict[str, dict[str, object]] = {
        each.ident: {
            "figures": [by_name[name] for name in named(each.figures) if name in by_name],
            "tables": [views[name] for name in named(each.tables) if name in views],
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
    sections = [
        section(each.ident, each.nav, title=each.nav, ask=each.ask, **parts[each.ident]) for each in _SECTIONS
    ]
    return page(
        "index",
        title=title or ", ".join(suite.title for suite in study.suites) + ": policy evolution report",
        lead=answers.scope,
        facts=[],
        looks=looks,
        notices=[Notice(study.post_hoc)] if study.post_hoc else [],
        answers=answers,
        overview=by_name.get("overview"),
        sections=[
            each
            for each in sections
            if each["figures"] or each["tables"] or each["links"] or each["id"] in ("replays", "left-out")
        ],
        footer="Agents evolve an executable policy under a budget of train episodes; the checkpoint that hidden"
        " validation selects is scored on hidden held-out cases. Only the held-out returns and their ranks are scores;"
        " all else is a diagnostic. Made by evopolicy report.",
        data="report.json",
    )


def table_view(table: Table, pages: Mapping[str, str] = {}) -> dict[str, Any]:
    """The table for a page, without columns of no values. `pages`: those of runs, by their names."""
    columns = [
        c for c in table.columns if not table.rows or any(row.get(c.key) is not None for row in table.rows)
    ]
    titles = [escape(visible(column.title)).replace(" /", Markup("&nbsp;/")) for column in columns]
    texts = [texts_of(table, column) for column in columns]
    runs = table.runs or [""] * len(table.rows)
    brief, _, method = table.caption.partition("? ")
    if method:
        brief += "?"
    else:
        brief, _, method = table.caption.partition(". ")
        brief += "." if method else ""
    return {
        "id": table.name.replace("_", "-") + "-table",
        "title": table.title,
        "caption": brief,
        "method": method,
        "files": [(label, f"tables/{table.name}.{suffix}") for label, suffix in FORMS],
        "filter": len(table.rows) >= _FILTER_FROM,
        "short": len(table.rows) > _ROWS,
        "columns": [
            {"title": title.replace("-", "\u2011"), "numeric": column.kind != "text", "note": column.note}
            for column, title in zip(columns, titles, strict=True)
        ],
        "rows": [
            [
                _cell(
                    column,
                    row.get(column.key),
                    table.marks.get((place, column.key), 0),
                    pages.get(run),
                    own[place],
                )
                for column, own in zip(columns, texts, strict=True)
            ]
            for place, (row, run) in enumerate(zip(table.rows, runs, strict=True))
        ],
    }


def _cell(column: Column, value: object, mark: int, page_of_run: str | None, text: str) -> dict[str, object]:
    numeric = column.kind != "text"
    is_long = not numeric and len(str(value)) > _LONG
    classes = {"n": numeric, "first": mark == 1, "second": mark == 2}
    classes |= {"none": value is None and not numeric, "long": is_long}
    return {
        "text": text,
        "value": ("" if value is None else value) if numeric else None,
        "cls": " ".join(name for name, holds in classes.items() if holds),
        "href": page_of_run if column.key == "run" else None,
        "entry": value if column.key == "entry" else None,
    }


def run_title(run: PastRun) -> str:
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
    checkpoints = _checkpoints(trace)
    used = run.submits[-1].consumed if run.submits else 0
    view = run_view(
        run.submits,
        trace,
        may_show=True,
        href=lambda submit: f"#{submit.label}-source" if submit.label in checkpoints else "",
        images=image_links,
        videos=videos,
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
        checkpoints=checkpoints,
    )


def _checkpoints(trace: Trace) -> dict[str, dict[str, object]]:
    """By label: the first checkpoint with the same files, and what changed since the one before."""
    out: dict[str, dict[str, object]] = {}
    previous: dict[str, str] | None = None
    labels: dict[str, str] = {}
    for submit in trace.run.submits:
        if texts := sources(trace.run, submit):
            same_as = labels.setdefault(repr(sorted(texts.items())), submit.label)
            diffs = [] if previous is None else diff(previous, texts)
            edit = trace.transitions[submit.index].edit if submit.index in trace.transitions else ""
            out[submit.label] = {"edit": edit, "same_as": same_as, "diffs": diffs, "texts": texts}
            previous = texts
    return out


class PlayedEpisode(NamedTuple):
    """A recorded episode of one run, with the parts of it that were copied into the report."""

    run: PastRun
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
