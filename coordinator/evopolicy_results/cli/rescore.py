"""`evopolicy rescore RUN…`: stored checkpoints on further hidden cases, written beside `run.json`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from evopolicy_common.cli.conventions import (
    Connect,
    CredentialsFile,
    Json,
    end_on_sigterm,
    fail,
    fail_on_our_errors,
    run_to_end,
)
from evopolicy_common.cli.frame import App
from evopolicy_common.console import listing, terminal
from evopolicy_common.errors import ConfigError
from evopolicy_common.processes.packages import packages_in
from evopolicy_common.records.rescores import is_name
from evopolicy_common.records.run_files import no_run_below, run_folders
from evopolicy_common.terminal import number, one_line, say, say_json
from evopolicy_results.cli.cluster import Local, Runs, State, Where
from evopolicy_results.rescore.play import RunToRescore, Wanted, Written, read_finished
from evopolicy_results.rescore.play import rescore as rescore_run

PARTIAL = 3

app = App(name="rescore")


@app.command(
    name="rescore",
    epilog=(
        "Example: evopolicy rescore runs --cases 256 --local && evopolicy report runs --scores cases-256 --out report"
    ),
)
def rescore(
    runs: Runs,
    cases: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=10_000,
            help="Number of new hidden cases, derived from the coordinator's secret.",
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder of split files with the held-out cases; with --cases, the first ones."),
    ] = None,
    all_checkpoints: Annotated[
        bool,
        typer.Option("--all-checkpoints", help="Play every eligible checkpoint, not only the selected one."),
    ] = False,
    name: Annotated[
        str | None,
        typer.Option(
            help="Name of the re-score: the same name gives the same new cases. Default: cases-N,"
            " or the data folder's name."
        ),
    ] = None,
    connect: Connect = None,
    file: CredentialsFile = None,
    local: Local = False,
    state: State = None,
    as_json: Json = False,
) -> None:
    """Play checkpoints of finished runs on further hidden cases, for tighter intervals.

    Writes rescore/NAME.json, for `evopolicy report --scores NAME`. A re-score is post hoc: it never changes run.json
    or the selected checkpoint. Repeat an interrupted command to continue it. Exit codes: 0 all re-scored, 1 the
    cluster failed, 2 wrong usage or no run can be re-scored, 3 some runs cannot.
    """
    if cases is None and data is None:
        fail("name the new cases: --cases 256 for their number, or --data FOLDER for split files")
    if data is not None and not data.is_dir():
        fail(f"--data {data} is not a folder")
    where = Where(connect, file, local, state, runs=runs)
    chosen = name or (f"cases-{cases}" if data is None else re.sub(r"[^A-Za-z0-9._-]+", "-", data.name))
    if not is_name(chosen):
        fail(f"--name {chosen!r}: letters, digits, '.', '_' and '-', at most 64, the first a letter or digit")
    wanted = Wanted(name=chosen, n_cases=cases, data=data, every=all_checkpoints)
    console = terminal(stderr=as_json)
    with fail_on_our_errors():
        folders, empty = run_folders(runs)
        if empty:
            raise ConfigError(no_run_below(empty[0]))
        finished, without, failed = read_finished(folders)
        for text in without:
            say(f"left out: {one_line(text)}", err=True)
        if not finished:
            raise ConfigError(failed[0] if failed else "none of these runs has a checkpoint to re-score")
        written: list[Written] = []

        async def work() -> None:
            end_on_sigterm()
            packages = _packages(finished) if local else ()
            async with where.playing("rescore", console, packages) as playing:

                async def rescore_runs() -> None:
                    for run in finished:
                        playing.update(title=f"{run.record.agent.entry} on {run.record.env}")
                        try:
                            written.append(await rescore_run(run, wanted, playing.evaluations))
                        except ConfigError as error:
                            failed.append(f"{run.folder}: {error}")

                envs = sorted({run.record.env for run in finished})
                await playing.run_work(envs, {run.record.sandbox_tier for run in finished}, rescore_runs)

        try:
            run_to_end(work())
            if not written:
                raise ConfigError(failed[0])
        finally:
            for text in failed if written else failed[1:]:
                say(f"not re-scored: {one_line(text)}", err=True)
            if written and as_json:
                say_json(written)
            elif written:
                columns = {
                    "environment": lambda one: one.env,
                    "entry": lambda one: one.entry,
                    "held-out mean": lambda one: number(one.score),
                    "re-scored mean": lambda one: number(one.rescored),
                    "episodes": lambda one: str(one.episodes),
                }
                console.print(listing(written, columns, right=("held-out mean",)))
    if failed:
        say(f"{len(written)} of {len(written) + len(failed)} runs are re-scored", err=True)
        raise typer.Exit(PARTIAL)
    if not as_json:
        say(f"next: evopolicy report {' '.join(map(str, runs))} --scores {chosen} --out report")


def _packages(runs: list[RunToRescore]) -> tuple[str, ...]:
    """Packages besides numpy that the runs' policies import. Raises ConfigError where they differ, since a cluster
    offers one set of packages."""
    packages = {packages_in(run.record.versions.fingerprint): run.folder for run in runs}
    if len(packages) > 1:
        each = sorted(packages.items())
        listed = "; ".join(f"{folder}: {', '.join(names) or 'none'}" for names, folder in each)
        raise ConfigError(
            f"policies of these runs import different packages ({listed}): re-score runs with the same packages at a"
            " time"
        )
    return next(iter(packages))
