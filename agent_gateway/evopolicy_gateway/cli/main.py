"""`evopolicy`: a table of all commands. A command's module is imported when it is called.

Help and completion therefore cost little more than typer itself. `tests/unit/test_start.py` checks the imports of this
module, and compares the table with the commands' own help.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import typer

from evopolicy_common.cli.frame import App, Group, Version, run_app
from evopolicy_gateway.processes import trees as processes


class Place(NamedTuple):
    """Module and help text of a command."""

    app: str
    """`module:name` of a `typer.Typer`, which holds the command or is it."""
    help: str
    """First sentence of its own help."""
    extra: str | None = None
    """Extra to name where a module is missing; None for that of the module."""


_PLAY = "evopolicy_gateway.cli.play:app"
_COORDINATOR = "evopolicy_coordinator.cli"
_RESULTS = "evopolicy_results.cli"

GROUPS = {
    "Play": {
        "demo": Place(
            _PLAY, "Play one run on this machine: the agent evolve on gym/continuouscar, 32 episodes."
        ),
        "replay": Place(
            _PLAY, "Play a recorded run again: the same agent, with its model's answers from the record."
        ),
        "try": Place(_PLAY, "Play a policy on train cases, without a run or an agent."),
        "random": Place(_PLAY, "Play uniform random actions on a split, as a reference for scores."),
        "local": Place(_PLAY, "Play runs on this machine."),
        "run": Place(_PLAY, "Play one run on a cluster."),
        "finish": Place(_PLAY, "Close the run of a remote agent."),
        "harbor": Place(
            "evopolicy_gateway.harbor.scores:app",
            "Write a Harbor task for each open run of a remote agent, and serve the runs' scores to Harbor's verifiers"
            " until Ctrl-C.",
        ),
        "suite": Place("evopolicy_gateway.cli.suite:app", "Play a sweep: agents × environments × repeats."),
    },
    "Results": {
        "report": Place(
            f"{_RESULTS}.report:app",
            "Write a report on finished runs: leaderboard, figures and diagnostics.",
        ),
        "diff": Place(
            _PLAY,
            "Compare two run directories, except for times, logs and other values that differ between equal runs.",
        ),
        "verify": Place(
            f"{_RESULTS}.verify:app",
            "Replay a run's recorded actions, and compare rewards, observations and returns bit for bit.",
        ),
        "rescore": Place(
            f"{_RESULTS}.rescore:app",
            "Play checkpoints of finished runs on further hidden cases, for tighter intervals.",
        ),
        "export": Place(
            "evopolicy._exports.command:app",
            "Export runs to tables, experiment trackers, trajectory datasets and agents' logs.",
        ),
        "publish": Place(
            f"{_RESULTS}.publish:app",
            "Write finished runs into one signed file that anyone can check, and make their cases public.",
        ),
        "check": Place(f"{_RESULTS}.publish:check_app", "Check published results."),
        "leaderboard": Place(
            "evopolicy_results.leaderboard.command:app",
            "Write a leaderboard of several labs' published results as a static site.",
        ),
    },
    "Cluster": {
        "status": Place(
            f"{_COORDINATOR}.status:status_app", "Show workers, runs, and the reasons why runs wait."
        ),
        "web": Place(
            f"{_COORDINATOR}.web:app", "Show sweeps, runs and the cluster in a browser, live.", "coordinator"
        ),
        "workers": Place(f"{_COORDINATOR}.status:workers_app", "List, drain, pause and resume workers."),
        "runs": Place(f"{_COORDINATOR}.status:runs_app", "List, cancel and repin runs."),
        "envs": Place(
            f"{_COORDINATOR}.envs:app",
            "List the environments that the cluster's workers offer, their definitions, and whether runs may use them.",
        ),
        "disk": Place(
            f"{_COORDINATOR}.gc:disk_app",
            "Show the disk space of stored runs by environment, and whether a planned sweep fits.",
        ),
        "gc": Place(
            f"{_COORDINATOR}.gc:gc_app",
            "Delete stored episodes and bundles of runs that finished long ago, and unreferenced blobs.",
        ),
    },
    "Setup and files": {
        "doctor": Place(
            "evopolicy_worker.sandbox.doctor_command:app",
            "Check this machine, and print the remedy for each missing part.",
        ),
        "files": Place(
            "evopolicy_gateway.cli.files:app",
            "List or copy the examples, deployment files and pages that come with evopolicy.",
        ),
        "texts": Place(
            "evopolicy_gateway.cli.files:app",
            "Print the standard texts for agents, as templates for --agents-md and --prompts.",
        ),
        "schema": Place(
            "evopolicy_gateway.cli.files:app", "Print the JSON Schema of one of evopolicy's files."
        ),
        "data": Place(
            f"{_COORDINATOR}.data:app",
            "Make and check the split files of environments (hidden cases: keep them from agents).",
        ),
    },
}
"""All commands, by the headings of the help."""
PLACES = {name: place for places in GROUPS.values() for name, place in places.items()}


class _Commands(Mapping[str, Any]):
    """The commands by name, each imported on first use."""

    def __getitem__(self, name: str) -> Any:
        module, _, app = PLACES[name].app.partition(":")
        command: Any = typer.main.get_command(getattr(importlib.import_module(module), app))
        command = getattr(command, "commands", {}).get(name, command)
        command.name = name
        return command

    def __iter__(self) -> Iterator[str]:
        return iter(PLACES)

    def __len__(self) -> int:
        return len(PLACES)


class _TopLevel(Group):
    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.commands = _Commands()  # type: ignore[assignment]  # nobody adds to it

    def list_commands(self, ctx: Any) -> list[str]:
        return list(PLACES)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        try:
            return super().get_command(ctx, cmd_name)
        except ModuleNotFoundError:
            if (
                ctx.resilient_parsing
            ):  # a line is completed: a command whose extra is missing completes nothing
                return None
            raise

    def command_groups(self, ctx: Any) -> dict[str, list[tuple[str, str]]]:
        return {
            heading: [(name, place.help) for name, place in places.items()]
            for heading, places in GROUPS.items()
        }


app = App(cls=_TopLevel, no_args_is_help=True, add_completion=True)


@app.callback()
def evopolicy(_: Version = False) -> None:
    """Evaluate agents that improve executable policies: play runs, and report their results.

    Exit codes of commands that play runs: 0 every run completed, 1 something failed, 2 a wrong option, 3 a run ended
    without an ok submit, 4 an agent failed, 5 a run was cancelled, 130 Ctrl-C. Of several runs, the most serious
    counts: 1, 5, 4, 3.
    """


def main() -> None:
    """The program."""
    processes.become_subreaper()
    command = PLACES.get(next((word for word in sys.argv[1:] if not word.startswith("-")), ""))
    run_app(app, command and command.extra)
