"""`evopolicy`: a table of all commands. A command's module is imported when it is called.

Help and completion therefore cost little more than typer itself. `tests/unit/test_start.py` checks the imports of this
module, and compares the table with the commands' own help.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Mapping
from typing import Any

import typer

from evopolicy_common.cli.frame import App, CommandGroup, Version, run_app
from evopolicy_gateway.processes import trees as processes

_MODULES = {
    "evopolicy_gateway.cli.play:app": "demo replay try random local run finish diff",
    "evopolicy_gateway.harbor.scores:app": "harbor",
    "evopolicy_gateway.cli.suite:app": "suite",
    "evopolicy_results.cli.report:app": "report",
    "evopolicy_results.cli.verify:app": "verify",
    "evopolicy_results.cli.rescore:app": "rescore",
    "evopolicy._exports.command:app": "export",
    "evopolicy_results.cli.publish:app": "publish",
    "evopolicy_results.cli.publish:check_app": "check",
    "evopolicy_results.leaderboard.command:app": "leaderboard",
    "evopolicy_coordinator.cli.status:status_app": "status",
    "evopolicy_coordinator.cli.web:app": "web",
    "evopolicy_coordinator.cli.status:workers_app": "workers",
    "evopolicy_coordinator.cli.status:runs_app": "runs",
    "evopolicy_coordinator.cli.envs:app": "envs",
    "evopolicy_coordinator.cli.gc:disk_app": "disk",
    "evopolicy_coordinator.cli.gc:gc_app": "gc",
    "evopolicy_worker.doctor:app": "doctor",
    "evopolicy_gateway.cli.files:app": "files",
    "evopolicy_coordinator.cli.data:app": "data",
}
"""Each `module:name` of a `typer.Typer`, which holds the named commands or is one."""
_EXTRAS = {"web": "coordinator"}
"""Extras to name where a command lacks a module, if not that of the module."""
GROUPS = {
    "Play": {
        "demo": "Play one run on this machine: the agent evolve on gym/continuouscar, 32 episodes.",
        "replay": "Play a recorded run again: the same agent, with its model's answers from the record.",
        "try": "Play a policy on train cases, without a run or an agent.",
        "local": "Play runs on this machine.",
        "run": "Play one run on a cluster.",
        "finish": "Close the run of a remote agent.",
        "harbor": "Write a Harbor task for each open run of a remote agent, and serve the runs' scores"
        " to Harbor's verifiers until Ctrl-C.",
        "suite": "Play a sweep: agents × environments × repeats.",
    },
    "Results": {
        "report": "Write a report on finished runs: leaderboard, figures and diagnostics.",
        "diff": "Compare two run directories, except for times, logs and other values that differ"
        " between equal runs.",
        "verify": "Replay a run's recorded actions, and compare rewards, observations and returns bit"
        " for bit.",
        "rescore": "Play checkpoints of finished runs on further hidden cases, for tighter intervals.",
        "export": "Export runs to tables, experiment trackers, trajectory datasets and agents' logs.",
        "publish": "Write finished runs into one signed file that anyone can check, and make their cases"
        " public.",
        "check": "Check published results.",
        "leaderboard": "Write a leaderboard of several labs' published results as a static site.",
    },
    "Cluster": {
        "status": "Show workers, runs, and the reasons why runs wait.",
        "web": "Show sweeps, runs and the cluster in a browser, live.",
        "workers": "Drain, pause and resume workers.",
        "runs": "Cancel and repin runs.",
        "envs": "List the environments that the cluster's workers offer, their definitions, and"
        " whether runs may use them.",
        "disk": "Show the disk space of stored runs by environment, and whether a planned sweep fits.",
        "gc": "Delete stored episodes and bundles of runs that finished long ago, and unreferenced blobs.",
    },
    "Setup and files": {
        "doctor": "Check this machine, and print the remedy for each missing part.",
        "files": "List, print or copy the examples, deployment files, standard texts, schemas and pages that come"
        " with evopolicy.",
        "data": "Make and check the split files of environments (hidden cases: keep them from agents).",
    },
}
"""All commands by the headings of the help, each with the first sentence of its own help."""
HELPS = {name: text for helps in GROUPS.values() for name, text in helps.items()}
_PLACES = {name: place for place, names in _MODULES.items() for name in names.split()}


class _Commands(Mapping[str, Any]):
    """The commands by name, each imported on first use."""

    def __getitem__(self, name: str) -> Any:
        module, _, app = _PLACES[name].partition(":")
        command: Any = typer.main.get_command(getattr(importlib.import_module(module), app))
        command = getattr(command, "commands", {}).get(name, command)
        command.name = name
        return command

    def __iter__(self) -> Iterator[str]:
        return iter(HELPS)

    def __len__(self) -> int:
        return len(HELPS)


class _TopLevel(CommandGroup):
    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.commands = _Commands()  # type: ignore[assignment]  # nobody adds to it

    def list_commands(self, ctx: Any) -> list[str]:
        return list(HELPS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        try:
            return super().get_command(ctx, cmd_name)
        except ModuleNotFoundError:
            if (
                ctx.resilient_parsing
            ):  # a line is completed: a command whose extra is missing completes nothing
                return None
            raise

    def command_groups(self, ctx: object) -> dict[str, list[tuple[str, str]]]:
        return {heading: list(helps.items()) for heading, helps in GROUPS.items()}


app = App(cls=_TopLevel, no_args_is_help=True, add_completion=True)


@app.callback()
def evopolicy(_: Version = False) -> None:
    """Evaluate agents that improve executable policies: play runs, and report their results.

    Exit codes of commands that play runs: 0 every run completed, 1 something failed, 2 a wrong option, 3 a run ended
    without an ok submit, 4 an agent failed, 5 a run was cancelled, 130 Ctrl-C. Of several runs, the most serious
    counts: 1, 5, 4, 3.
    """


def main() -> None:
    processes.become_subreaper()
    command = next((word for word in sys.argv[1:] if not word.startswith("-")), "")
    run_app(app, _EXTRAS.get(command))
