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
from evopolicy_results.behaviour.trace import Trace, trace
from evopolicy_results.figures import drawings_of, timelines_of
from evopolicy_results.figures.plot import Plot
from evopolicy_results.html.pages import (
    FORMS,
    PlayedEpisode,
    default_title,
    failed_page,
    index_page,
    replays_page,
    trace_page,
)
from evopolicy_results.reading.environments import names_in_runs, ordered_environments
from evopolicy_results.reading.parallel import ALONE, Processes
from evopolicy_results.reading.records import Run, path_text
from evopolicy_results.studies.palette import Look, looks
from evopolicy_results.studies.study import Study
from evopolicy_results.tables.latex import to_latex
from evopolicy_results.tables.report_tables import tables_of
from evopolicy_results.tables.run_tables import feedback_use, submits_of
from evopolicy_results.tables.table import Table, to_csv, to_markdown

REPORT_SCHEMA_VERSION = 1
_OURS = frozenset({"index.html", "report.json", "figures", "tables", "traces", "replays"})
_WRITTEN = {"csv": to_csv, "md": to_markdown, "tex": to_latex}

Progress = Callable[[str, int, int], None]
"""Called with (what, done, total)."""


def write_report(
    study: Study,
    out: Path,
    *,
    title: str | None = None,
    traces: bool = True,
    processes: Processes = ALONE,
    progress: Progress | None = None,
) -> Path:
    """Writes the report of `study` into the folder `out` (created if missing) and returns its `index.html`.

    Raises ConfigError when `out` exists and is neither empty nor an earlier report. Without `traces` the pages of
    single runs are left out, which saves most of the time and space of a large report. `processes` draw figures
    and write the pages of runs; call it on the main thread.
    """
    tell = progress if progress is not None else lambda what, done, total: None
    _prepare(out)
    look = looks(study.entries, study.reference)
    trace_links = {run.name: f"traces/{slug(run)}.html" for run in study.runs} if traces else {}
    tables = tables_of(study, lambda run: trace_links.get(run, ""))
    plots: list[Plot] = []
    submits: list[dict[str, Any]] = []
    drawings = drawings_of(study)
    pages = _pages(study, out, look) if traces else []
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
        (out / "figures" / f"{plot.name}.svg").write_text(plot.svg, encoding="utf-8")
    if traces:
        tables.append(feedback_use(submits))
    for done, table in enumerate(tables, start=1):
        for _, suffix in FORMS:
            text = _WRITTEN[suffix](table)
            (out / "tables" / f"{table.name}.{suffix}").write_text(text, encoding="utf-8", errors="replace")
        tell("tables", done, len(tables))
    replay_links = _write_replays(study, out, look)
    page = index_page(
        study,
        title=title or default_title(study),
        looks=look,
        tables=tables,
        figures=plots,
        trace_links=trace_links,
        replay_links=replay_links,
    )
    (out / "report.json").write_bytes(_report_json(study, tables, plots))
    index = out / "index.html"
    index.write_text(page, encoding="utf-8", errors="replace")
    return index


def slug(run: Run) -> str:
    """A file name for the run's page: readable, and unique by a hash of the run's name."""
    text = re.sub(r"[^A-Za-z0-9.-]+", "-", f"{run.env}-{run.entry}-{run.record.exp_id}").strip("-.")[:90]
    return f"{text}-{hashlib.sha256(run.name.encode()).hexdigest()[:8]}"


def _prepare(out: Path) -> None:
    if out.exists():
        if not out.is_dir():
            raise ConfigError(f"--out {out} is a file; give a folder")
        others = sorted(child.name for child in out.iterdir() if child.name not in _OURS)
        if others:
            raise ConfigError(
                f"--out {out} holds other files ({', '.join(others[:3])}…); give a new or an earlier report's folder"
            )
        for name in ("figures", "tables", "traces", "replays"):
            shutil.rmtree(out / name, ignore_errors=True)
    for name in ("figures", "tables"):
        (out / name).mkdir(parents=True, exist_ok=True)


def _made(item: tuple[dict[str, set[tuple[str, str]]], partial[Any]]) -> Any:
    names_in_runs.update(item[0])  # those of another process
    made = item[1]()
    if isinstance(made, Plot):
        from evopolicy_results.figures.style import drawn  # imports matplotlib

        made = drawn(made)
    return made


def _lost(item: tuple[Any, partial[Any]], why: str) -> Any:
    """Replaces a run's page whose process ended; a figure has nothing of an agent's that could end its process."""
    if item[1].func is not _page:
        raise ChildProcessError(why)
    run, out, *_ = item[1].args
    _write_failed(run, out, why)
    return []


def _pages(study: Study, out: Path, look: Mapping[str, Look]) -> list[partial[list[dict[str, Any]]]]:
    """Writes the page of each run and returns its submits."""
    (out / "traces").mkdir(exist_ok=True)
    by_env: dict[str, list[Run]] = {}
    for run in study.runs:
        by_env.setdefault(run.env, []).append(run)
    return [
        partial(
            _page,
            run,
            out,
            look.get(run.entry),
            [
                (other.entry, look.get(other.entry), f"{slug(other)}.html")
                for other in _beside(run, by_env[run.env])
            ],
        )
        for run in study.runs
    ]


def _page(
    run: Run, out: Path, look: Look | None, beside: Sequence[tuple[str, Look | None, str]]
) -> list[dict[str, Any]]:
    try:
        traced = trace(run)
        _write_trace(traced, out, look, beside)
        return submits_of(traced)
    except Exception as error:
        # A bad log or source that an agent wrote must spoil at most its own page.
        _write_failed(run, out, f"{type(error).__name__}: {error}")
        return []


def _write_failed(run: Run, out: Path, why: str) -> None:
    page = failed_page(run, why)
    (out / "traces" / f"{slug(run)}.html").write_text(page, encoding="utf-8", errors="replace")


def _beside(run: Run, runs: Sequence[Run]) -> list[Run]:
    """One run of each other agent on the same environment, with the same repeat number if there is one."""
    chosen: dict[str, Run] = {}
    for other in runs:
        if other.entry != run.entry:
            first = chosen.setdefault(other.entry, other)
            if first.record.repeat != run.record.repeat == other.record.repeat:
                chosen[other.entry] = other
    return list(chosen.values())


def _write_trace(
    found: Trace, out: Path, look: Look | None, beside: Sequence[tuple[str, Look | None, str]]
) -> None:
    folder = out / "traces"
    name = slug(found.run)
    image_links: dict[int, list[tuple[str, str]]] = {}
    videos: dict[int, str] = {}
    for row in found.rows:
        for number, path in enumerate(row.images):
            target = folder / name / f"{row.submit.label}-{number}{path.suffix.lower()}"
            if _copy(path, target):
                image_links.setdefault(row.submit.index, []).append((path.name, f"{name}/{target.name}"))
        if row.video is not None and _copy(row.video, folder / name / f"{row.submit.label}.mp4"):
            videos[row.submit.index] = f"{name}/{row.submit.label}.mp4"
    page = trace_page(
        found,
        look=look,
        image_links=image_links,
        videos=videos,
        beside=beside,
    )
    (folder / f"{name}.html").write_text(page, encoding="utf-8", errors="replace")


def _copy(path: Path, target: Path) -> bool:
    """Copies a file; returns False when it is missing or a link."""
    if not path.is_file() or path.is_symlink():
        return False
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, target)
    return True


def _write_replays(study: Study, out: Path, look: Mapping[str, Look]) -> dict[str, str]:
    by_env: dict[str, list[PlayedEpisode]] = {}
    for run in study.runs:
        for number, replay in enumerate(run.record.replays):
            stem = f"media/{slug(run)}-{number:03d}"
            video = _copied(run, replay.path, out / "replays", stem)
            strip = _copied(run, replay.filmstrip, out / "replays", stem) if replay.filmstrip else None
            by_env.setdefault(run.env, []).append(
                PlayedEpisode(
                    run=run,
                    split=replay.split,
                    episode=replay.episode,
                    submit_index=replay.submit_index,
                    episode_return=replay.episode_return,
                    length=replay.length,
                    video=video,
                    strip=strip,
                )
            )
    links: dict[str, str] = {}
    for env in ordered_environments(by_env):
        name = f"replays/{re.sub(r'[^A-Za-z0-9.-]+', '-', env)}.html"
        (out / "replays").mkdir(exist_ok=True)
        (out / name).write_text(replays_page(env, by_env[env], look), encoding="utf-8", errors="replace")
        links[env] = name
    return links


def _copied(run: Run, path: str, folder: Path, stem: str) -> str | None:
    """Copies a run's file into the report; returns None when it is missing, outside the run directory, or no image or
    video."""
    source = (run.path / path).resolve()
    if not source.is_relative_to(run.path.resolve()) or source.suffix.lower() not in (
        ".mp4",
        ".png",
        ".webm",
    ):
        return None
    target = folder / f"{stem}{source.suffix.lower()}"
    return f"{stem}{source.suffix.lower()}" if _copy(source, target) else None


def _report_json(study: Study, tables: list[Table], plots: list[Plot]) -> bytes:
    content = {
        "schema_version": REPORT_SCHEMA_VERSION,
        "runs": [
            {
                "name": run.name,
                "path": path_text(run.path),
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
