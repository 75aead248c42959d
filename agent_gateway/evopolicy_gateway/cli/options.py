"""Options that commands share besides those of a run, and the cluster that its options choose."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import typer

from evopolicy_common.errors import ConfigError
from evopolicy_common.processes.packages import checked_names
from evopolicy_common.wire.credentials import local_state_dir
from evopolicy_gateway.operator.cluster import Cluster
from evopolicy_gateway.run.run_options import ClusterOptions

RUN, CLUSTER = "Run", ClusterOptions.group

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON; progress goes to stderr.")]
Web = Annotated[
    bool,
    typer.Option(
        "--web",
        help="Show the runs live in a browser, at the address that is printed. See `evopolicy web`.",
        rich_help_panel=RUN,
    ),
]

_LOCAL_ONLY = {
    "audit": "--audit applies only with --local; otherwise set it at the coordinator: evopolicy-coordinator --audit",
    "hidden_isolation": "--hidden-isolation applies only to a cluster started by this command; otherwise set it at the"
    " coordinator: evopolicy-coordinator --hidden-isolation",
    "policy_package": "--policy-package is for a cluster that this command brings up; give it to"
    " evopolicy-coordinator and to each evopolicy-worker",
    "browser": "--browser is for a cluster that this command brings up; give it to each evopolicy-worker",
    **dict.fromkeys(
        ("env_timeout", "env_memory"),
        "--env-timeout and --env-memory are for a cluster that this command brings up; give them to each"
        " evopolicy-worker",
    ),
}
"""Refusals of options of a local cluster where another one is used."""


def cluster_of(
    given: ClusterOptions, connect: list[str] | None, file: Path | None, *, local: bool | None = None
) -> Cluster:
    """The cluster that a command plays on; `local` None: its own unless one is named. ConfigError for an option that
    does not go with it."""
    local = not (connect or file) if local is None else local
    packages = list(checked_names(given.policy_package))
    if not local:
        for name, text in _LOCAL_ONLY.items():
            if getattr(given, name):
                raise ConfigError(text)
        return Cluster(connect=tuple(connect or ()), file=file)
    if given.fresh and given.state is not None:
        raise ConfigError(f"--fresh and --state {given.state}: give only one of them")
    state = None if given.fresh else given.state or local_state_dir()
    browser = None if given.browser is None else given.browser.absolute()
    options = msgspec.structs.replace(given, state=state, browser=browser, policy_package=packages)
    return Cluster(local=options)
