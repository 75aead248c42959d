"""Writes a report folder: pages, figures, tables, data. The only part of the analysis that writes files.

    index.html                self-contained: includes figures, styles and scripts
    report.json               every table and every figure's data
    figures/*.svg             tables/*.csv, *.md, *.tex
    traces/*.html             one page per run, images beside it
    replays/*.html            one page per environment with recordings, videos beside it

Files of an earlier report in the same folder are overwritten. A folder with any other content is refused.
"""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_results.behaviour.trace import trace
from evopolicy_results.figures import drawings_of, timelines_of
from evopolicy_results.figures.plot import Plot
from evopolicy_results.html import page
from evopolicy_results.html.pages import (
    FORMS,
    PlayedEpisode,
    index_page,
    replays_page,
    run_title,
    trace_page,
)
from evopolicy_results.reading.environments import grouped, names_in_runs, ordered_environments
from evopolicy_results.reading.parallel import ALONE, Processes
from evopolicy_results.reading.records import PastRun, path_text
from evopolicy_results.studies.palette import Look, looks
from evopolicy_results.studies.study import Study
from evopolicy_results.tables.latex import to_latex
from evopolicy_results.tables.report_tables import tables_of
from evopolicy_results.tables.run_tables import feedback_use, submits_of
from evopolicy_results.tables.table import Table, to_csv, to_markdown

REPORT_SCHEMA_VERSION = 1
_FOLDERS = ("figures", "tables", "traces", "replays")
_OURS = frozenset({"index.html", "report.json", *_FOLDERS})
_MEDIA = (".mp4", ".png", ".webm")
_NO_NAME = re.compile(r"[^A-Za-z0-9.-]+")
_WRITTEN = {"csv": to_csv, "md": to_markdown, "tex": to_latex}

Progress = Callable[[str, int, int], None]
"""Called with (what, done, total)."""


def write_report(
    study: Study,
    out: Path,
    *,
    title: str | None = None,
    traces: bool = True,
    places: Mapping[Path, str] | None = None,
    processes: Processes = ALONE,
    progress: Progress | None = None,
) -> Path:
    """Writes the report of `study` into the folder `out` (created if missing) and returns its `index.html`.

    Raises ConfigError when `out` exists and is neither empty nor an earlier report. Without `traces` the pages of
    single runs are left out, which saves most of the time and space of a large report. `places`: other texts
    for the paths of runs in `report.json`. `processes` draw figures and write the pages of runs; call it on the main
    thread.
    """
    tell = progress or (lambda what, done, total: None)
    check_folder(out, _OURS.__contains__, "report")
    for name in _FOLDERS:
        shutil.rmtree(out / name, ignore_errors=True)
    for name in ("figures", "tables"):
        (out / name).mkdir(parents=True, exist_ok=True)
    look = looks(study.entries, study.reference)
    tables, drawings = tables_of(study), drawings_of(study)
    pages = [
        partial(_page, run, out, look.get(run.entry), _beside(run, runs, look))
        for runs in grouped(study.runs if traces else (), lambda run: run.env).values()
        for run in runs
    ]
    plots: list[Plot] = []
    submits: list[dict[str, object]] = []
    stages: list[partial[Any]] = [*drawings, *pages]
    work = [(names_in_runs, each) for each in stages]
    for done, made in enumerate(processes.map(_made, work, _lost, at_once=1), start=1):
        if done <= len(drawings):
            plots += [made] if made is not None else []
            tell("figures", done, len(drawings))
        else:
            submits += made
            tell("run pages", done - len(drawings), len(pages))
    plots += timelines_of(study)
    for plot in plots:
        write_file(out / "figures" / f"{plot.name}.svg", plot.svg)
    if traces:
        tables.append(feedback_use(submits))
    for done, table in enumerate(tables, start=1):
        for _, suffix in FORMS:
            write_file(out / "tables" / f"{table.name}.{suffix}", _WRITTEN[suffix](table))
        tell("tables", done, len(tables))
    (out / "report.json").write_bytes(_report_json(study, tables, plots, places or {}))
    text = index_page(
        study,
        title=title,
        looks=look,
        tables=tables,
        figures=plots,
        trace_links={run.name: f"traces/{slug(run)}.html" for run in study.runs if traces},
        replay_links=_write_replays(study, out, look),
    )
    return write_file(out / "index.html", text)


def slug(run: PastRun) -> str:
    """A file name for the run's page: readable, and unique by a hash of the run's name."""
    text = _NO_NAME.sub("-", f"{run.env}-{run.entry}-{run.record.exp_id}").strip("-.")[:90]
    return f"{text}-{hashlib.sha256(run.name.encode()).hexdigest()[:8]}"


def check_folder(out: Path, is_ours: Callable[[str], bool], kind: str) -> None:
    """Raises ConfigError when `out` is a file, or holds files that no earlier command of this kind wrote there."""
    if out.exists() and not out.is_dir():
        raise ConfigError(f"--out {out} is a file; give a folder")
    names = sorted(child.name for child in out.iterdir()) if out.exists() else []
    if others := [name for name in names if not is_ours(name)]:
        raise ConfigError(
            f"--out {out} holds other files ({', '.join(others[:3])}…); give a new or an earlier {kind}'s folder"
        )


def _made(item: tuple[dict[str, set[tuple[str, str]]], partial[object]]) -> Any:
    names_in_runs.update(item[0])  # those of another process
    made = item[1]()
    if not isinstance(made, Plot):
        return made
    from evopolicy_results.figures.style import drawn  # imports matplotlib

    return drawn(made)


def _lost(item: tuple[object, partial[object]], why: str) -> object:
    """Replaces a run's page whose process ended; a figure has nothing of an agent's that could end its process."""
    if item[1].func is not _page:
        raise ChildProcessError(why)
    run, out, *_ = item[1].args
    return _write_failed(run, out, why)


def _page(
    run: PastRun, out: Path, look: Look | None, beside: Sequence[tuple[str, Look | None, str]]
) -> list[dict[str, object]]:
    """Writes the page of a run, with its images and videos beside it, and returns its submits."""
    name, folder = slug(run), out / "traces"
    image_links: dict[int, list[tuple[str, str]]] = {}
    videos: dict[int, str] = {}
    try:
        traced = trace(run)
        for submit in run.submits:
            stem, index = f"{name}/{submit.label}", submit.index
            for number, path in enumerate(traced.images.get(index, ())):
                if copied := _copied(path, folder, f"{stem}-{number}"):
                    image_links.setdefault(index, []).append((path.name, copied))
            if (video := traced.videos.get(index)) and (copied := _copied(video, folder, stem)):
                videos[index] = copied
        text = trace_page(traced, look=look, image_links=image_links, videos=videos, beside=beside)
        write_file(folder / f"{name}.html", text)
        return submits_of(traced)
    except Exception as error:
        # A bad log or source that an agent wrote must spoil at most its own page.
        return _write_failed(run, out, f"{type(error).__name__}: {error}")


def _write_failed(run: PastRun, out: Path, why: str) -> list[dict[str, object]]:
    write_file(out / "traces" / f"{slug(run)}.html", page("failed", title=run_title(run), reason=why))
    return []


def _beside(
    run: PastRun, runs: Sequence[PastRun], look: Mapping[str, Look]
) -> list[tuple[str, Look | None, str]]:
    """One run of each other agent, with the same repeat number if there is one."""
    chosen: dict[str, PastRun] = {}
    for other in runs:
        if other.entry != run.entry:
            first = chosen.setdefault(other.entry, other)
            if first.record.repeat != run.record.repeat == other.record.repeat:
                chosen[other.entry] = other
    return [(entry, look.get(entry), f"{slug(other)}.html") for entry, other in chosen.items()]


def _copied(path: Path, folder: Path, stem: str) -> str | None:
    """Copies a file and returns its path in `folder`; None when it is missing or a link."""
    if not path.is_file() or path.is_symlink():
        return None
    name = f"{stem}{path.suffix.lower()}"
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, folder / name)
    return name


def _write_replays(study: Study, out: Path, look: Mapping[str, Look]) -> dict[str, str]:
    def copied(run: PastRun, path: str | None, number: int) -> str | None:
        """None too for a file outside the run directory, and for any but an image or video."""
        source = (run.path / (path or "")).resolve()
        if not source.is_relative_to(run.path.resolve()) or source.suffix.lower() not in _MEDIA:
            return None
        return _copied(source, out / "replays", f"media/{slug(run)}-{number:03d}")

    played = [
        PlayedEpisode(run, each, copied(run, each.path, number), copied(run, each.filmstrip, number))
        for run in study.runs
        for number, each in enumerate(run.record.replays)
    ]
    by_env = grouped(played, lambda each: each.run.env)
    links: dict[str, str] = {}
    for env in ordered_environments(by_env):
        links[env] = f"replays/{_NO_NAME.sub('-', env)}.html"
        write_file(out / links[env], replays_page(env, by_env[env], look))
    return links


def write_file(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8", errors="replace")
    return path


def _report_json(study: Study, tables: list[Table], plots: list[Plot], places: Mapping[Path, str]) -> bytes:
    content = {
        "schema_version": REPORT_SCHEMA_VERSION,
        "runs": [
            {
                "name": run.name,
                "path": places.get(run.path) or path_text(run.path),
                "entry": run.entry,
                "env": run.env,
                "exp_id": run.record.exp_id,
                "repeat": run.record.repeat,
                "score": run.score,
            }
            for run in study.runs
        ],
        "left_out": [{"path": path_text(item.path), "reason": item.reason} for item in study.left_out],
        "post_hoc": study.post_hoc,
        "mixtures": [str(mixture) for mixture in study.mixtures],
        "tables": {
            table.name: {
                "title": table.title,
                "caption": table.caption,
                "columns": [column.key for column in table.columns],
                "rows": table.rows,
            }
            for table in tables
        },
        "figures": {
            plot.name: {"title": plot.title, "caption": plot.caption, "data": plot.data} for plot in plots
        },
    }
    return msgspec.json.format(msgspec.json.encode(content, enc_hook=str), indent=1) + b"\n"
