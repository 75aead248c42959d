"""`evopolicy run`, `local`, `try`, `diff` and `finish`: commands that play or compare runs and episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import typer

from evopolicy_common import catalogue
from evopolicy_common.cli.conventions import Connect, CredentialsFile, fail, fail_on_our_errors, run_to_end
from evopolicy_common.cli.frame import App
from evopolicy_common.console import terminal
from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.episode import ResourceLimits, Tier
from evopolicy_common.processes.preflight import LOCAL, check_installed
from evopolicy_common.records.run_difference import differences, shortened
from evopolicy_common.terminal import say_json, say_lines
from evopolicy_gateway import shipped
from evopolicy_gateway.cli import options
from evopolicy_gateway.cli.options import Of, Shown, spread
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.operator.cluster import ChosenCluster
from evopolicy_gateway.run import recorded_agent
from evopolicy_gateway.run.plan import Plan, check_apart
from evopolicy_gateway.run.run_options import (
    ClusterOptions,
    ListenerOptions,
    RunOptions,
    cases_of,
    one_environment,
    packages_for,
)
from evopolicy_gateway.run_folder import listener
from evopolicy_gateway.run_folder.layout import folder_of
from evopolicy_gateway.suite import runs as plain_runs
from evopolicy_gateway.suite.suite_index import exit_code

app = App()


@app.command(epilog="Example: evopolicy run --env gym/acrobot --agent evolve --credentials operator-me")
@spread
def run(
    *,
    env: options.Env,
    connect: Connect = None,
    credentials_file: CredentialsFile = None,
    given: RunOptions,
    jail: JailSettings,
    served: ListenerOptions,
    as_json: options.Json = False,
) -> None:
    """Play one run on a cluster.

    Starts the run's gateway and agent on this machine, and ends when run.json is written.
    """
    where = ChosenCluster(connect=tuple(connect or ()), file=credentials_file, patient=given.resume)
    held = jail.of_remote_agent() if given.agent == listener.AGENT else jail
    agent_host = listener.agent_host_of(given.agent, served.agent_host)
    plans = _checked(given.plans([one_environment(env)], held, agent_host, served.listener()))
    _play(plans, where, 1, as_json)


@app.command(epilog="Example: evopolicy local --env core16 --agent evolve --budget 8 --parallel 2")
@spread
def local(
    *,
    env: options.Envs,
    given: RunOptions,
    jail: JailSettings,
    parallel: Annotated[
        int, typer.Option(min=1, max=64, help="Runs at once.", rich_help_panel=options.RUN)
    ] = 1,
    cluster: ClusterOptions,
    as_json: options.Json = False,
) -> None:
    """Play runs on this machine.

    Starts a coordinator and a worker, plays one run for each environment, and stops everything at the end.
    """
    check_installed(LOCAL)
    plans = _checked(given.plans(catalogue.resolve(env), jail))
    where = options.cluster_of(cluster, None, None, local=True)
    _play(plans, where, parallel, as_json)


@app.command(epilog="Example: evopolicy demo")
@spread
def demo(
    *,
    runs: Annotated[Path, typer.Option(help="Folder of run directories.")] = Path("runs"),
) -> None:
    """Play one run on this machine: the agent evolve on gym/continuouscar, 32 episodes. Takes about a minute.

    The run directory is runs/evolve/gym_continuouscar/demo; the next demo replaces it.
    """
    check_installed(LOCAL)
    given = RunOptions(agent="evolve", budget=32, exp_id="demo", overwrite=True, runs=runs)
    plans = _checked(given.plans(["gym/continuouscar"], JailSettings()))
    where = options.cluster_of(ClusterOptions(), None, None, local=True)
    _play(plans, where, 1, as_json=False)


@app.command(
    "try", epilog="Example: evopolicy try examples/policies/gym_acrobot --env gym/acrobot --cases 0-3"
)
@spread
def try_policy(
    *,
    policy_dir: Annotated[Path, typer.Argument(help="Folder with a policy.py.", show_default=False)],
    env: options.Env,
    cases: Annotated[
        str,
        typer.Option(help="Train ids and ranges. Without --fresh, equal ids are equal cases in every call."),
    ] = "0-3",
    out: Annotated[
        Path, typer.Option(help="Folder for trajectories; each call makes a folder in it.")
    ] = Path("tries"),
    connect: Connect = None,
    credentials_file: CredentialsFile = None,
    tier: Annotated[Tier, Of(RunOptions)],
    limits: Annotated[ResourceLimits, Of(RunOptions)],
    cluster: Annotated[ClusterOptions, Shown(without=("hidden_isolation",))],
    as_json: options.Json = False,
) -> None:
    """Play a policy on train cases, without a run or an agent.

    Starts a local cluster unless --connect or --credentials name one. A policy in a run's directory gets the run's
    packages unless --policy-package names others. Exit code 1 if the policy failed.
    """
    # With numpy, which a command that plays runs does without.
    from evopolicy_gateway.operator import trials

    env_id, ids = one_environment(env), cases_of(cases)
    policy = shipped.found(policy_dir, Path.cwd())
    if not (connect or credentials_file):
        packages = list(packages_for(policy, cluster.policy_package))
        cluster = msgspec.structs.replace(cluster, policy_package=packages)
    where = options.cluster_of(cluster, connect, credentials_file)
    where = msgspec.structs.replace(where, unjailed=tier == "none")
    where.check_train(env_id, ids)
    bundle = trials.policy_bundle(policy)
    message = trials.evaluation(env_id, bundle, ids, tier, limits)
    raise typer.Exit(run_to_end(trials.try_policy(bundle, message, out, where, as_json=as_json)))


@app.command("diff", epilog="Example: evopolicy diff runs/evolve/gym_acrobot/a runs/evolve/gym_acrobot/b")
def diff_runs(
    left: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="A run directory.")],
    right: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="Another run directory.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print all differences, as JSON.")] = False,
) -> None:
    """Compare two run directories, except for values that differ between equal runs, such as times and logs.

    Exit code 0 if they are equal, 1 if they differ.
    """
    with fail_on_our_errors():
        for each in (left, right):
            root = folder_of(each).root  # for typer a pipe is no file
            if not ((root / "run.json").exists() or (root / "workspace").is_dir()):
                raise ConfigError(f"{each} is no run directory: it has neither run.json nor workspace/")
        lines = differences(left, right)
    if as_json:
        say_json(lines, indent=False)
    else:
        say_lines(shortened(lines, left, right) or ["no difference (times and logs aside)"])
    raise typer.Exit(1 if lines else 0)


@app.command(epilog="Example: evopolicy replay runs/gpt-5.5/gym_acrobot/first")
@spread
def replay(
    *,
    run_directory: Annotated[
        Path, typer.Argument(help="A run that was played with --record-model full.", show_default=False)
    ],
    runs: Annotated[Path, typer.Option(help="Folder of the replayed runs.")] = Path("replayed"),
    trust: Annotated[
        bool,
        typer.Option("--trust", help="Also replay others' runs, which runs their programs."),
    ] = False,
    connect: Connect = None,
    credentials_file: CredentialsFile = None,
    cluster: Annotated[
        ClusterOptions,
        Shown(without=("slots", "hidden_isolation", "policy_package", "env_timeout", "env_memory")),
    ],
) -> None:
    """Play a recorded run again: the same agent, with its model's answers from the record.

    Needs no model and no key. Prints `identical`, or the first difference, with exit code 1. Starts a local cluster
    unless --connect or --credentials name one.
    """
    plan = recorded_agent.plan_of(folder_of(run_directory).root, runs, trusted=trust)
    plan.check()
    where = options.cluster_of(cluster, connect, credentials_file)
    if where.local is not None:
        local = msgspec.structs.replace(where.local, policy_package=list(packages_for(run_directory, None)))
        where = msgspec.structs.replace(where, local=local)
    try:
        run_to_end(plain_runs.play_plans([plan], where, 1, terminal(stderr=True)))
    except KeyboardInterrupt:
        fail("interrupted", 130)
    difference = recorded_agent.outcome(run_directory, plan)
    say_lines(difference.splitlines() or ["identical"])
    raise typer.Exit(int(bool(difference)))


@app.command(epilog="Example: evopolicy finish runs/their-agent/gym_acrobot/20260115-093000")
def finish(
    run_directory: Annotated[
        Path, typer.Argument(help="Folder of an open run with --agent remote.", show_default=False)
    ],
) -> None:
    """Close the run of a remote agent.

    The run is scored, and its `evopolicy run` ends.
    """
    with fail_on_our_errors():
        listener.finish(folder_of(run_directory))


def _checked(plans: list[Plan]) -> list[Plan]:
    """Raises ConfigError for any error before anything is started."""
    check_apart(plans)
    for plan in plans:
        plan.check()
    return plans


def _play(plans: list[Plan], where: ChosenCluster, parallel: int, as_json: bool) -> None:
    where = msgspec.structs.replace(where, unjailed=_unjailed(plans))
    console = terminal(stderr=as_json)
    try:
        played = run_to_end(plain_runs.play_plans(plans, where, parallel, console))
    except KeyboardInterrupt:
        fail("interrupted; runs whose agent was at work are cancelled and cannot be resumed", 130)
    if as_json:
        say_json(plain_runs.documents(played))
    else:
        plain_runs.report(played, plans[0].runs, console)
    raise typer.Exit(exit_code(plans, played.index))


def _unjailed(plans: list[Plan]) -> bool:
    """Whether an agent or a policy could read the files of this user."""
    return any(plan.jail.mode != "bwrap" or plan.settings.sandbox_tier == "none" for plan in plans)
