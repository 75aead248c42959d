"""Options that several commands share, and how their values become settings. A wrong value is a ConfigError."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.episode import Tier
from evopolicy_common.processes.packages import checked_names
from evopolicy_common.wire.credentials import local_state_dir

RUN, SCORE, POLICY, AGENT, JAIL, REMOTE, CLUSTER = (
    "Run",
    "Score",
    "Policy and feedback",
    "Agent",
    "Agent's jail",
    "Remote agent (--agent remote)",
    "Local cluster",
)
"""Groups of options in the commands' help, in the order in which they stand there."""

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON; progress goes to stderr.")]
Slots = Annotated[
    int,
    typer.Option(
        min=1,
        max=1024,
        help="Episodes that the local worker plays at the same time. Environments in a virtual environment of their"
        " own have a worker with as many.",
        rich_help_panel=CLUSTER,
    ),
]
Limits = Annotated[
    list[str] | None,
    typer.Option(
        "--limit",
        metavar="NAME=VALUE",
        help="Limit for the policy, such as act_wall_s=5 or memory_bytes=2e9; may be repeated.",
        rich_help_panel=POLICY,
    ),
]
DataFolder = Annotated[
    Path | None,
    typer.Option(
        help="Folder of split files (`evopolicy data make`); default: derived from the state's secret.",
        rich_help_panel=CLUSTER,
    ),
]
StateFolder = Annotated[
    Path | None,
    typer.Option(
        help="State folder of the local cluster. Default: $XDG_STATE_HOME/evopolicy/local, which all your local runs share, so"
        " that they have the same cases.",
        rich_help_panel=CLUSTER,
        show_default=False,
    ),
]
Fresh = Annotated[
    bool,
    typer.Option(
        "--fresh",
        help="Use a temporary state folder: new cases, and no later comparison or `verify`.",
        rich_help_panel=CLUSTER,
    ),
]
TierName = Annotated[Tier, typer.Option(help="Sandbox around the policy.", rich_help_panel=POLICY)]
Audit = Annotated[
    float,
    typer.Option(
        min=0.0,
        max=1.0,
        metavar="SHARE",
        rich_help_panel=CLUSTER,
        help="Share of the episodes whose actions a second local worker replays, compared bit for bit.",
    ),
]

Web = Annotated[
    bool,
    typer.Option(
        "--web",
        help="Show the runs live in a browser, at the address that is printed. See `evopolicy web`.",
        rich_help_panel=RUN,
    ),
]

HiddenIsolation = Literal["related", "strict", "off"]
Isolation = Annotated[
    HiddenIsolation | None,
    typer.Option(
        "--hidden-isolation",
        help="Agents beside which no hidden episode is played on a kernel: those of runs with the same hidden cases (related, the"
        " default), all (strict), or none (off).",
        rich_help_panel=CLUSTER,
        show_default=False,
    ),
]
PolicyPackages = Annotated[
    list[str] | None,
    typer.Option(
        "--policy-package",
        metavar="NAME",
        help="Package that policies may import in addition to numpy; may be repeated.",
        rich_help_panel=CLUSTER,
    ),
]
Browser = Annotated[
    Path | None,
    typer.Option(
        exists=True,
        dir_okay=False,
        help="Chromium's program for the local worker's web pages; default: the machine's own.",
        rich_help_panel=CLUSTER,
        show_default=False,
    ),
]
EnvTimeout = Annotated[
    float | None,
    typer.Option(
        min=1.0,
        help="Time limit for one call of an environment, in seconds, as of evopolicy-worker; default: 300.",
        rich_help_panel=CLUSTER,
        show_default=False,
    ),
]
EnvMemory = Annotated[
    int | None,
    typer.Option(
        min=64,
        help="Memory limit of an environment's process, in MiB, as of evopolicy-worker; default: 4096.",
        rich_help_panel=CLUSTER,
        show_default=False,
    ),
]
HiddenCasesOption = Annotated[
    Literal["shared", "per-run"] | None,
    typer.Option(
        "--hidden-cases",
        help="shared: the same for all runs of an environment (default); per-run: the run's own, so that runs cannot be paired.",
        rich_help_panel=SCORE,
        show_default=False,
    ),
]


ProfileOption = Annotated[
    Literal["published", "published-data"] | None,
    typer.Option(
        help="published: all settings of the published protocol (docs/reference/protocol.md), with its case files in --data and the"
        " paper's 16 validation and 32 held-out cases; published-data: with all 64 and 256 of the files.",
        rich_help_panel=RUN,
        show_default=False,
    ),
]


def state_of(state: Path | None, *, fresh: bool) -> Path | None:
    """The state folder of a local cluster; None for a temporary one. Raises ConfigError when both options are given."""
    if fresh and state is not None:
        raise ConfigError(f"--fresh and --state {state}: give only one of them")
    return None if fresh else state or local_state_dir()


def check_packages(requested: list[str] | None, *, local: bool) -> tuple[str, ...]:
    """The packages of `--policy-package`. ConfigError for a cluster that is not brought up here."""
    names = checked_names(requested)
    if names and not local:
        raise ConfigError(
            "--policy-package is for a cluster that this command brings up; give it to evopolicy-coordinator and to each"
            " evopolicy-worker"
        )
    return names


def check_browser(requested: Path | None, *, local: bool) -> Path | None:
    """The browser of `--browser`. ConfigError for a cluster that is not brought up here."""
    if requested is not None and not local:
        raise ConfigError(
            "--browser is for a cluster that this command brings up; give it to each evopolicy-worker"
        )
    return None if requested is None else requested.absolute()


def check_env_limits(*requested: float | None, local: bool) -> None:
    """ConfigError where `--env-timeout` or `--env-memory` is given for a cluster that is not brought up here."""
    if not local and any(each is not None for each in requested):
        raise ConfigError(
            "--env-timeout and --env-memory are for a cluster that this command brings up; give them to each evopolicy-worker"
        )


def check_isolation(requested: HiddenIsolation | None, *, local: bool) -> None:
    """ConfigError where `--hidden-isolation` is given for a cluster that is not brought up here."""
    if requested is not None and not local:
        raise ConfigError(
            "--hidden-isolation applies only to a cluster started by this command; otherwise set it at the coordinator:"
            " evopolicy-coordinator --hidden-isolation"
        )
