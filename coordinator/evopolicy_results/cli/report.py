"""`evopolicy report`: run directories in, a folder with the report out.

It reads hidden scores, so it comes with the coordinator's extra. Needs no coordinator, worker or simulator.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evopolicy_common.cli.conventions import Json, code_of, fail
from evopolicy_common.cli.frame import App
from evopolicy_common.console import progress_bars, terminal
from evopolicy_common.errors import ConfigError, raised_as
from evopolicy_common.processes.preflight import check_writable
from evopolicy_common.records.rescores import is_name
from evopolicy_common.regular_files import read_given
from evopolicy_common.terminal import counted, say, say_json, say_lines
from evopolicy_results.reading.comparability import REMEDIES, MixedRunsError
from evopolicy_results.reading.parallel import Processes
from evopolicy_results.reading.reader import find_run_dirs, load_runs, rescored
from evopolicy_results.reading.records import LeftOut
from evopolicy_results.scoring.scores import ScoreTable, read_score_csv
from evopolicy_results.studies.study import Study, study_of

if TYPE_CHECKING:
    from evopolicy_results.report import Progress as Tell

NOTHING, MIXED = 1, 3

app = App(name="report")


@app.command(
    name="report",
    epilog="Example: evopolicy report runs --out report && xdg-open report/index.html",
)
def report(
    runs: Annotated[
        list[Path],
        typer.Argument(
            help="Run directories, folders of them, or a CSV of held-out returns of other agents"
            " (entry,harness,<environment>,…)."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder to write; a new one, or an earlier report's.")],
    scores: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Use the held-out scores of this re-score, labelled as post hoc.",
        ),
    ] = None,
    allow_mixed: Annotated[
        bool,
        typer.Option(
            "--allow-mixed",
            help="Compare runs although their settings or fingerprints differ; the report says so.",
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Write a report on finished runs: leaderboard, figures and diagnostics."""
    try:
        check_writable(out, "--out")
        tables = [path for path in runs if path.suffix == ".csv" and path.is_file()]
        table = _score_table(tables)
        folders, without = find_run_dirs(path for path in runs if path not in tables)
        written_by = "evopolicy_results.report"
        # Without a run there is nothing to do for them.
        jobs = (os.cpu_count() or 1) if folders else 1
        with Processes(jobs, written_by, "evopolicy_results.figures.style") as processes, _progress() as tell:
            if folders or table is not None:
                import_module(written_by)  # while the children do
            study = _study(folders, without, table, scores, allow_mixed, processes, tell)
            index = None
            if study.suites:
                # Here, not above: it needs jinja2, and `evopolicy` loads this module to list its commands.
                from evopolicy_results.report import write_report

                index = write_report(study, out, processes=processes, progress=tell)
    except MixedRunsError as error:
        kinds = [one.what for one in error.mixtures]
        same = dict.fromkeys(REMEDIES[kind] for kind in kinds if kind in REMEDIES)
        advice = [f"Runs compare that were played with {'; '.join(same)}."] if same else []
        say_lines([f"error: {error}".splitlines()[0], *str(error).splitlines()[1:], *advice], err=True)
        say("Give the folders of runs that agree, or --allow-mixed to compare them all the same.", err=True)
        raise SystemExit(MIXED) from error
    except ConfigError as error:
        fail(str(error), code_of(error))
    if as_json:
        left_out = [{"path": str(item.path), "reason": item.reason} for item in study.left_out]
        place = str(index) if index is not None else None
        say_json({"index": place, "runs": len(study.runs), "left_out": left_out}, indent=False)
    else:
        say_lines((f"left out: {item.path}: {item.reason}" for item in study.left_out), err=True)
        if index is not None:
            say(f"{counted(len(study.runs), 'run')}, {len(study.left_out)} left out: {index}")
    if index is None:
        fail(
            f"no finished run in {', '.join(map(str, runs))}; nothing written. Name run directories, such as"
            " runs/evolve/gym_acrobot/first, or folders that contain them",
            NOTHING,
        )


def _score_table(paths: list[Path]) -> ScoreTable | None:
    if len(paths) > 1:
        raise ConfigError(f"one CSV of held-out returns at most, not {len(paths)}")
    for path in paths:
        with raised_as(ConfigError, f"{path} cannot be read", UnicodeDecodeError):
            return read_score_csv(read_given(path, str(path)).decode(), source=str(path))
    return None


def _study(
    folders: list[Path],
    left_out: list[LeftOut],
    scores: ScoreTable | None,
    rescore: str | None,
    allow_mixed: bool,
    processes: Processes,
    tell: Tell,
) -> Study:
    if rescore and not is_name(rescore):
        raise ConfigError(
            f"--scores {rescore!r} cannot be the name of a re-score: use letters, digits, '.', '_' and '-'"
        )
    loaded = load_runs(
        folders, processes=processes, progress=lambda done, total: tell("runs read", done, total)
    )
    tell("statistics", 0, 1)
    study = study_of(
        rescored(loaded.runs, rescore) if rescore else loaded.runs,
        left_out=(*left_out, *loaded.left_out),
        allow_mixed=allow_mixed,
        scores=scores,
    )
    tell("statistics", 1, 1)
    return study


@contextmanager
def _progress() -> Iterator[Tell]:
    """A bar for each stage on standard error, when that is a terminal."""
    with progress_bars(terminal(stderr=True)) as progress:
        tasks = {}

        def tell(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield tell
