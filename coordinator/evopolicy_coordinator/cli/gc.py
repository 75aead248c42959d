"""`evopolicy gc` and `evopolicy disk`: commands on a coordinator's state folder, running or not.

Exit codes: 0 all well, 1 what is planned does not fit or the disk refused, 2 wrong usage.
"""

from __future__ import annotations

from typing import Annotated

import typer

from evopolicy_common import catalogue
from evopolicy_common.cli.conventions import State, bytes_text
from evopolicy_common.cli.frame import App
from evopolicy_common.processes.preflight import check_writable
from evopolicy_common.terminal import counted, say
from evopolicy_common.wire.credentials import default_state_dir
from evopolicy_coordinator.storage import disk_use

gc_app = App(name="gc")
disk_app = App(name="disk")


@gc_app.command(epilog="Example: evopolicy gc --state /var/lib/evopolicy --older-than 7 --dry-run")
def collect(
    state: State = None,
    older_than: Annotated[
        float, typer.Option(min=0.0, help="Days since the end of a run; younger runs stay.")
    ] = 7.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only print what would be deleted.")] = False,
) -> None:
    """Delete stored episodes and bundles of runs that finished long ago, and unreferenced blobs.

    Keeps run directories and the outcomes of runs. The coordinator may be running.
    """
    root = state or default_state_dir()
    if root.is_dir() and not dry_run:
        check_writable(root, "--state", may_be_full=True)
    done = disk_use.collect(root, older_than * 24 * 3600.0, dry_run=dry_run)
    verb = "would remove" if dry_run else "removed"
    say(
        f"{verb} {counted(done.episodes, 'episode')} of {counted(done.runs, 'run')} and"
        f" {counted(done.evaluations, 'evaluation')}, {counted(done.blobs, 'blob')}:"
        f" {bytes_text(done.bytes)}; {bytes_text(done.free_bytes)} free"
    )
    if not dry_run and not done.shrunk:
        say("the database keeps its size, and new runs use the freed space")


@disk_app.command(epilog="Example: evopolicy disk --env core16 --budget 128 --runs 5")
def disk(
    state: State = None,
    env: Annotated[
        list[str] | None, typer.Option(help="Suite, suite id or glob of the planned sweep; may be repeated.")
    ] = None,
    budget: Annotated[
        int | None, typer.Option(min=1, help="Train episodes of each planned run; default: the suite's.")
    ] = None,
    runs: Annotated[int, typer.Option(min=1, help="Planned runs on each environment.")] = 1,
) -> None:
    """Show the disk space of stored runs by environment, and whether a planned sweep fits.

    Also prints the size of run directories. Exit code 1 if the sweep does not fit.
    """
    root = state or default_state_dir()
    used = disk_use.use(root)
    planned = {
        env_id: runs * (budget or catalogue.suite_of(env_id).budget)
        for env_id in catalogue.resolve(env or [])
    }
    needed = disk_use.estimate(root, planned) if planned else None
    directories = sum(catalogue.entry(env_id).feedback_bytes(n) for env_id, n in planned.items())
    for each in used:
        say(
            f"{each.env:<32}{counted(each.runs, 'run'):>10}{counted(each.train_episodes, 'episode'):>18}"
            f"{bytes_text(each.bytes):>12}{bytes_text(each.bytes_per_episode):>12} an episode"
        )
    if needed is not None:
        more = f"; estimated without earlier runs: {', '.join(needed.guessed)}" if needed.guessed else ""
        say(f"planned: about {bytes_text(needed.bytes)}, {bytes_text(needed.free_bytes)} are free{more}")
        say(f"run directories, in addition: at most {bytes_text(directories)}")
    if needed is not None and not needed.fits:
        raise typer.Exit(1)
