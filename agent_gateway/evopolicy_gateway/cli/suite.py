"""`evopolicy suite`: prints the plan of a sweep and plays it; when repeated, continues it.

Exit codes: 0 every run completed, 1 something failed or was not begun, 2 a wrong option or file, 3 a run ended without
an ok submit, 4 an agent failed, 5 a run was cancelled, 130 interrupted.
"""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from evopolicy_common.cli.conventions import (
    Connect,
    CredentialsFile,
    bytes_text,
    fail,
    run_to_end,
)
from evopolicy_common.cli.frame import App
from evopolicy_common.console import Terminal, terminal
from evopolicy_common.errors import ConfigError
from evopolicy_common.local.cluster import unless_failed
from evopolicy_common.messages.gateway import Profile
from evopolicy_common.processes.preflight import check_installed, check_loopback, check_writable
from evopolicy_common.records.run_files import read_record
from evopolicy_common.records.suite_folder import FINISHED, INDEX, Index
from evopolicy_common.wire.credentials import SWEEP_STATE
from evopolicy_gateway.cli import options
from evopolicy_gateway.cli.options import Of, Shown, spread
from evopolicy_gateway.operator.cluster import ChosenCluster, connected
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.run_options import ClusterOptions, RunOptions
from evopolicy_gateway.run_folder.locks import alone
from evopolicy_gateway.suite import decisions, suite_file, suite_index
from evopolicy_gateway.suite.claimed import ClaimedSweep, facts_of
from evopolicy_gateway.suite.decisions import Changed, Decision
from evopolicy_gateway.suite.suite_file import SuiteFile
from evopolicy_gateway.suite.suite_index import exit_code, next_step
from evopolicy_gateway.suite.suite_view import JsonView, SuiteView, results_table

app = App()


@app.command("suite", epilog="Example: evopolicy suite smoke.toml --local")
@spread
def suite(
    *,
    file: Annotated[
        str,
        typer.Argument(
            help=(
                "TOML file; included: smoke.toml, breadth.toml, world-controls.toml, core16.toml,"
                " core16-paper.toml, core16-published.toml."
            )
        ),
    ],
    connect: Connect = None,
    credentials_file: CredentialsFile = None,
    local: options.Local = False,
    runs: Annotated[Path | None, typer.Option(help="The sweep's folder; default: runs/NAME.")] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(help="Glob of the runs to play, such as 'evolve/*'; may be repeated."),
    ] = None,
    profile: Annotated[Profile | None, Of(RunOptions)],
    parallel: Annotated[
        int | None, typer.Option(min=1, max=256, help="Runs at the same time; overrides the file.")
    ] = None,
    changed: Annotated[
        Changed, typer.Option(help="Action for runs whose settings have changed in the file.")
    ] = "refuse",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan, and stop.")] = False,
    cluster: Annotated[
        ClusterOptions,
        Shown(
            without=("fresh", "env_timeout", "env_memory"),
            help={"state": "State folder of the local cluster; default: .cluster in the sweep's folder."},
        ),
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print events as JSON lines.")] = False,
) -> None:
    """Play a sweep: agents × environments × repeats.

    After an interruption, repeat the command to continue the sweep.
    """
    if local and (connect or credentials_file):
        raise ConfigError("--local starts a cluster of its own; it cannot be combined with --connect")
    where = options.cluster_of(cluster, connect, credentials_file, local=local)
    wanted = suite_file.read_suite(file)
    if parallel is not None:
        limits = msgspec.structs.replace(wanted.parallel, machine=parallel)
        wanted = msgspec.structs.replace(wanted, parallel=limits)
    if profile is not None:
        defaults = msgspec.structs.replace(wanted.defaults, profile=profile)
        wanted = msgspec.structs.replace(wanted, defaults=defaults)
    root = (runs or Path("runs") / wanted.name).absolute()
    expanded = suite_file.expand(wanted, root, Path.cwd(), tuple(only or ()))
    kept = cluster.state or root / SWEEP_STATE
    new = not kept.exists()  # then a dry run keeps none
    if where.local is not None:
        chosen = msgspec.structs.replace(where.local, state=None if new and dry_run else kept)
        where = msgspec.structs.replace(where, local=chosen)
    patient = not local and (root / INDEX).exists()
    where = msgspec.structs.replace(where, patient=patient)
    where.check_cases(run.settings for run in expanded)
    try:
        code = run_to_end(_suite(wanted, expanded, root, where, changed, dry_run, as_json))
    except KeyboardInterrupt:
        fail("interrupted; repeat the command to continue the sweep", 130)
    raise typer.Exit(code)


async def _suite(
    suite: SuiteFile,
    runs: Sequence[Plan],
    root: Path,
    where: ChosenCluster,
    changed: Changed,
    dry_run: bool,
    as_json: bool,
) -> int:
    console = terminal(stderr=as_json)
    check_writable(root, "--runs")
    check_loopback()
    check_installed("gateway")
    with alone(root / ".lock", root):
        index = suite_index.load(root, suite.name)
        env_ids = list(dict.fromkeys(run.settings.env for run in runs))
        tiers = {run.settings.sandbox_tier for run in runs}
        async with connected(where, env_ids, tiers) as (operations, gateway, failed):
            facts = [(run, await facts_of(run, index, operations)) for run in runs]
            decided = [decisions.decide(run, known, changed) for run, known in facts]
            _tell(suite, root, index, decided, console)
            if as_json:
                planned = JsonView([], 1)
                for one in decided:
                    planned.event("planned", one.run.name, what=one.kind, attempt=one.attempt, why=one.why)
            decisions.check_changes(decided, changed)
            if dry_run:
                return 0
            begun = [one.run for one in decided if one.kind in ("new", "resume", "restart")]
            suite_file.check_agents_start(begun)
            for one in decided:
                if one.kind == "keep":
                    _keep(index, one)
                elif one.run.name not in index.runs:
                    # The live view then also shows the reasons of waiting runs.
                    index.runs[one.run.name] = suite_index.waiting(one.run)
            suite_index.save(root, index)
            names = [run.name for run in runs]
            known = (names, suite.parallel.machine)
            view = JsonView(*known) if as_json else SuiteView(*known, console)
            with view.shown():
                for one in decided:
                    if one.kind == "keep":
                        view.kept(one.run.name, index.runs.get(one.run.name))
                sweep = ClaimedSweep(suite, root, index, operations, gateway, view)
                await unless_failed(asyncio.create_task(sweep.play_runs(decided)), failed)
    entries = [entry for entry in map(index.runs.get, names) if entry and entry.state != "pending"]
    if not as_json:
        console.print(results_table(entries))
        if (usage := suite_index.usage_line(index)) is not None:
            console.print(usage)
        console.print(f"index: {root / INDEX}", soft_wrap=True)
        if any(entry.state == "completed" for entry in entries):
            console.print(next_step(root), soft_wrap=True)
    return exit_code(runs, index)


def _tell(suite: SuiteFile, root: Path, index: Index, decided: list[Decision], console: Terminal) -> None:
    # Runs that --only leaves out are still the file's.
    in_file = {run.name for run in suite_file.expand(suite, root, Path.cwd())}
    left_alone = [name for name in index.runs if name not in in_file]
    for line in decisions.lines(decided, left_alone):
        console.print(line, soft_wrap=True)
    needed, free = decisions.feedback_bytes(decided), shutil.disk_usage(root).free
    if needed:
        fits = "" if needed <= free else "; it may not fit: make room, or choose another --runs"
        console.print(
            f"feedback takes at most {bytes_text(needed)} of the {bytes_text(free)} that are free in"
            f" {root}{fits}",
            highlight=False,
            soft_wrap=True,
        )


def _keep(index: Index, decision: Decision) -> None:
    """Brings the index in line with a finished run's own record."""
    run = decision.run
    entry = index.runs.get(run.name)
    if run.folder.run_json.exists() and (entry is None or entry.state not in FINISHED):
        record = read_record(run.folder.root)
        made, settings = suite_index.entry_of(run, record), msgspec.to_builtins(run.defining)
        if entry is not None:
            made = msgspec.structs.replace(made, digest=entry.digest, earlier=entry.earlier)
            settings = entry.settings
        index.runs[run.name] = msgspec.structs.replace(made, settings=settings)
