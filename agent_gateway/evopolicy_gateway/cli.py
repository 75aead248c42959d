"""`evopolicy`: the front door. Plays runs, and whole local clusters with them; other rooms add subcommands.

Exit codes: 0 every run completed, 1 something failed, 2 a wrong option, 3 a run ended without an ok submit, 130 Ctrl-C.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Coroutine
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import typer

from evopolicy_common import catalogue
from evopolicy_common.cli import fail, fail_on_our_errors, run_app
from evopolicy_common.errors import ConfigError
from evopolicy_common.run_difference import differences
from evopolicy_gateway import door, harnesses, options, processes, trials
from evopolicy_gateway.door import Door
from evopolicy_gateway.gateway import folder_of
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.options import RunOptions
from evopolicy_gateway.play import Plan
from evopolicy_gateway.runs import Cluster, exit_code, play_all
from evopolicy_gateway.runs import report as report_runs
from evopolicy_gateway.suite.suite_cli import suite as play_suite

T = TypeVar("T")

COMMANDS_GROUP = "evopolicy.commands"

app = typer.Typer(add_completion=False, no_args_is_help=True, rich_markup_mode=None)


@app.callback()
def evopolicy() -> None:
    """Evaluates agents that evolve policies: opens runs, plays them, and tells what they came to."""


Entry = Annotated[str | None, typer.Option(help="Name of the leaderboard entry; default: the agent's.")]
Model = Annotated[str | None, typer.Option(help="Name of the model behind the agent; default: the entry's.")]
ExpId = Annotated[str | None, typer.Option(help="Name of this experiment; default: the time.")]
Repeat = Annotated[int, typer.Option(min=0, help="Which repeat of the same agent and environment this is.")]
Budget = Annotated[int | None, typer.Option(min=1, help="Train episodes; default: the suite's.")]
MinEpisodes = Annotated[int | None, typer.Option(min=1, help="Fewest episodes of a submit.")]
MaxEpisodes = Annotated[int | None, typer.Option(min=1, help="Most episodes of a submit.")]
Validation = Annotated[int | None, typer.Option(min=1, help="Hidden validation cases.")]
Heldout = Annotated[int | None, typer.Option(min=1, help="Hidden held-out cases.")]
Scope = Annotated[str, typer.Option(help="episode: a fresh Policy each; submit: one through a submit.")]
Observations = Annotated[str, typer.Option(help="arrays, or lists as in v2.0-draft.")]
TierName = Annotated[str, typer.Option(help="Sandbox tier that the run demands: bwrap, landlock, none.")]
Video = Annotated[str, typer.Option(help="Videos in the feedback: off, first, all.")]
Replays = Annotated[
    str | None,
    typer.Option(help="Videos of the score's held-out episodes: off, first, all; default: as --video."),
]
Wall = Annotated[float, typer.Option(min=1.0, help="Seconds that the agent may take.")]
Runs = Annotated[Path, typer.Option(help="Folder of run directories.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a run of that name.")]
Resume = Annotated[
    bool, typer.Option("--resume", help="Go on with the run of that --exp-id, whose command was killed.")
]
Parallel = Annotated[int, typer.Option(min=1, max=64, help="Runs at once.")]
WALL_S = 12 * 3600.0


@app.command(epilog="Example: evopolicy run --env gym/acrobot --agent evolve --credentials operator-me")
def run(
    env: Annotated[str, typer.Option(help="Suite id, such as gym/acrobot.", show_default=False)],
    agent: options.AgentName,
    connect: options.Connect = None,
    credentials_file: options.CredentialsFile = None,
    local: Annotated[
        bool,
        typer.Option("--local", help="Bring up a coordinator and a worker here, as `evopolicy local` does."),
    ] = False,
    budget: Budget = None,
    model: Model = None,
    entry: Entry = None,
    exp_id: ExpId = None,
    repeat: Repeat = 0,
    min_episodes: MinEpisodes = None,
    max_episodes: MaxEpisodes = None,
    validation: Validation = None,
    heldout: Heldout = None,
    policy_scope: Scope = "episode",
    observations: Observations = "arrays",
    tier: TierName = "bwrap",
    video: Video = "off",
    replays: Replays = None,
    limit: options.Limits = None,
    agent_wall_s: Wall = WALL_S,
    jail: options.JailMode = "bwrap",
    jail_bind: options.JailBind = None,
    jail_bind_rw: options.JailBindWritable = None,
    jail_env: options.JailVariable = None,
    allow_host: options.AllowHost = None,
    http: options.Http = None,
    http_url: options.HttpUrl = None,
    runs: Runs = Path("runs"),
    overwrite: Overwrite = False,
    resume: Resume = False,
    slots: options.Slots = 2,
    as_json: options.Json = False,
) -> None:
    """Plays one run: opens it at the coordinator, starts gateway and agent, follows them to run.json."""
    with fail_on_our_errors():
        if local and (connect or credentials_file):
            raise ConfigError(
                "--local brings up a cluster of its own; it does not go with --connect or --credentials"
            )
        given = RunOptions(
            agent=agent,
            entry=entry or harnesses.entry_name(agent),
            model=model,
            exp_id=exp_id,
            repeat=repeat,
            budget=budget,
            min_episodes=min_episodes,
            max_episodes=max_episodes,
            validation=validation,
            heldout=heldout,
            policy_scope=policy_scope,
            observations=observations,
            tier=tier,
            video=video,
            replays=replays,
            limits=limit or (),
        )
        served = options.door_from(http, http_url)
        if agent == door.AGENT:
            held = options.no_jail_of_ours(jail, jail_bind, jail_bind_rw, jail_env, allow_host)
        else:
            held = options.jail_of(jail, jail_bind, jail_bind_rw, jail_env, allow_host)
        env_ids = [options.one_environment(env)]
        plans = _plans(given, env_ids, runs, agent_wall_s, (overwrite, resume), held, served)
        where = Cluster(connect=tuple(connect or ()), file=credentials_file)
        if local:
            where = Cluster(local_slots=slots)
        _play(plans, where, 1, as_json)


@app.command(epilog="Example: evopolicy local --env core16 --agent evolve --budget 8 --parallel 2")
def local(
    env: Annotated[
        list[str],
        typer.Option(
            help="Suite (core16), suite id or glob (gymnasium/MiniGrid-*); may be repeated.",
            show_default=False,
        ),
    ],
    agent: options.AgentName,
    budget: Budget = None,
    model: Model = None,
    entry: Entry = None,
    exp_id: ExpId = None,
    repeat: Repeat = 0,
    min_episodes: MinEpisodes = None,
    max_episodes: MaxEpisodes = None,
    validation: Validation = None,
    heldout: Heldout = None,
    policy_scope: Scope = "episode",
    observations: Observations = "arrays",
    tier: TierName = "bwrap",
    video: Video = "off",
    replays: Replays = None,
    limit: options.Limits = None,
    agent_wall_s: Wall = WALL_S,
    jail: options.JailMode = "bwrap",
    jail_bind: options.JailBind = None,
    jail_bind_rw: options.JailBindWritable = None,
    jail_env: options.JailVariable = None,
    allow_host: options.AllowHost = None,
    runs: Runs = Path("runs"),
    overwrite: Overwrite = False,
    resume: Resume = False,
    parallel: Parallel = 1,
    slots: options.Slots = 2,
    state: options.StateFolder = None,
    data: options.DataFolder = None,
    audit: options.Audit = 0.0,
    as_json: options.Json = False,
) -> None:
    """Plays runs on this machine alone: coordinator, worker and gateways come up, play, and go again."""
    with fail_on_our_errors():
        given = RunOptions(
            agent=agent,
            entry=entry or harnesses.entry_name(agent),
            model=model,
            exp_id=exp_id,
            repeat=repeat,
            budget=budget,
            min_episodes=min_episodes,
            max_episodes=max_episodes,
            validation=validation,
            heldout=heldout,
            policy_scope=policy_scope,
            observations=observations,
            tier=tier,
            video=video,
            replays=replays,
            limits=limit or (),
        )
        held = options.jail_of(jail, jail_bind, jail_bind_rw, jail_env, allow_host)
        plans = _plans(given, catalogue.resolve(env), runs, agent_wall_s, (overwrite, resume), held)
        where = Cluster(local_slots=slots, state=state, data=data, audit=audit)
        _play(plans, where, parallel, as_json)


@app.command("try", epilog="Example: evopolicy try examples/policies/acrobot --env gym/acrobot --cases 0-3")
def try_policy(
    policy_dir: Annotated[Path, typer.Argument(help="Folder with a policy.py.", show_default=False)],
    env: Annotated[str, typer.Option(help="Suite id, such as gym/acrobot.", show_default=False)],
    cases: Annotated[str, typer.Option(help="Train ids and ranges.")] = "0-3",
    out: Annotated[Path, typer.Option(help="Where trajectories go, in a new folder each time.")] = Path(
        "tries"
    ),
    connect: options.Connect = None,
    credentials_file: options.CredentialsFile = None,
    tier: TierName = "bwrap",
    limit: options.Limits = None,
    slots: options.Slots = 2,
    state: options.StateFolder = None,
    data: options.DataFolder = None,
    as_json: options.Json = False,
) -> None:
    """Plays a policy on train cases, without a run, an agent or a budget: a first look at what it does.

    Brings up a local cluster unless --connect or --credentials name one. Exit code 1 when the policy failed.
    """
    with fail_on_our_errors():
        trial = trials.Trial(
            env=options.one_environment(env),
            policy=policy_dir,
            split="train",
            cases=options.cases_of(cases),
            out=out,
            tier=options.tier_of(tier),
            limits=options.limits_of(limit or ()),
        )
        where = _trial_cluster(connect, credentials_file, slots, state, data)
        _exit(_run(trials.try_policy(trial, where, as_json=as_json)))


@app.command("random", epilog="Example: evopolicy random --env gym/acrobot --split heldout")
def play_random(
    env: Annotated[
        list[str], typer.Option(help="Suite, suite id or glob; may be repeated.", show_default=False)
    ],
    split: Annotated[str, typer.Option(help="train, validation or heldout.")] = "heldout",
    cases: Annotated[str | None, typer.Option(help="Ids and ranges in the split; default: all.")] = None,
    connect: options.Connect = None,
    credentials_file: options.CredentialsFile = None,
    slots: options.Slots = 2,
    state: options.StateFolder = None,
    data: options.DataFolder = None,
    as_json: options.Json = False,
) -> None:
    """Plays uniform random actions on a split: the reference that scores are held against."""
    with fail_on_our_errors():
        chosen = None if cases is None else options.cases_of(cases)
        if split not in ("train", "validation", "heldout"):
            raise ConfigError(f"--split {split!r}: there are train, validation, heldout")
        where = _trial_cluster(connect, credentials_file, slots, state, data)
        _exit(_run(trials.play_random(catalogue.resolve(env), split, chosen, where, as_json=as_json)))


@app.command("diff", epilog="Example: evopolicy diff runs/evolve/gym_acrobot/a runs/evolve/gym_acrobot/b")
def diff_runs(
    left: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="A run directory.")],
    right: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="Another.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the differences as JSON.")] = False,
) -> None:
    """Says where two runs differ, leaving out times, logs and what else may differ between equal runs.

    Exit code 0 when they are equal, 1 when they are not.
    """
    found = differences(left, right)
    if as_json:
        typer.echo(msgspec.json.encode(found).decode())
    else:
        typer.echo("\n".join(found) if found else "no difference (times and logs aside)")
    raise typer.Exit(1 if found else 0)


@app.command(epilog="Example: evopolicy finish runs/their-agent/gym_acrobot/20260115-093000")
def finish(
    run_directory: Annotated[
        Path, typer.Argument(help="Folder of an open run with --agent remote.", show_default=False)
    ],
) -> None:
    """Says that a remote agent is done: its run takes no more submits, is scored, and its `evopolicy run` ends."""
    with fail_on_our_errors():
        door.finish(folder_of(run_directory))


app.command("suite", epilog="Example: evopolicy suite smoke.toml --local")(play_suite)


def _plans(
    given: RunOptions,
    env_ids: list[str],
    runs: Path,
    wall_limit_s: float,
    replaced: tuple[bool, bool],
    jail: JailSettings,
    served: Door | None = None,
) -> list[Plan]:
    """A plan for each environment. ConfigError for whatever is wrong with any of them, before anything is started.

    `replaced`: what becomes of a run of that name, as `--overwrite` and `--resume` say.
    """
    overwrite, resume = replaced
    if resume and (overwrite or given.exp_id is None):
        raise ConfigError("--resume needs the --exp-id of the run, and does not go with --overwrite")
    started_in = Path.cwd()
    harnesses.make(given.agent, started_in)
    exp_id = given.exp_id or options.default_exp_id()
    plans = [
        Plan(
            settings=given.settings(env_id, exp_id),
            agent=given.agent,
            runs=runs,
            started_in=started_in,
            wall_limit_s=wall_limit_s,
            overwrite=overwrite,
            resume=resume,
            jail=jail,
            door=served,
        )
        for env_id in env_ids
    ]
    for plan in plans:
        plan.check()
    return plans


def _play(plans: list[Plan], where: Cluster, parallel: int, as_json: bool) -> None:
    console = options.console(stderr=as_json)
    results = _run(play_all(plans, where, parallel, console))
    if as_json:
        print(msgspec.json.format(msgspec.json.encode(results)).decode())
    else:
        report_runs(results, console)
    _exit(exit_code(results))


def _trial_cluster(
    connect: list[str] | None, file: Path | None, slots: int, state: Path | None, data: Path | None
) -> Cluster:
    if connect or file:
        return Cluster(connect=tuple(connect or ()), file=file)
    return Cluster(local_slots=slots, state=state, data=data)


def _run(work: Coroutine[Any, Any, T]) -> T:
    """Runs it to its end; SIGTERM, which cancels it, ends the command as Ctrl-C does."""
    try:
        return asyncio.run(work)
    except asyncio.CancelledError:
        raise KeyboardInterrupt from None


def _exit(code: int) -> None:
    if code:
        raise typer.Exit(code)


def _add_commands_of_other_rooms(arguments: list[str]) -> None:
    """Loads a subcommand when it is named, and all of them for the help: what they import may be large, or missing."""
    found: dict[str, EntryPoint] = {point.name: point for point in entry_points(group=COMMANDS_GROUP)}
    named = arguments[0] if arguments else "--help"
    wanted = [found[named]] if named in found else list(found.values()) if named == "--help" else []
    for point in wanted:
        try:
            _mount(point.load(), point.name)
        except ImportError as error:
            if named == point.name:
                fail(
                    f"evopolicy {named} is not installed here ({error}): pip install 'evopolicy[coordinator]'"
                )


def _mount(other: typer.Typer, name: str) -> None:
    """Adds another room's commands under `name`; an app of one command is that command, not a group of one."""
    if len(other.registered_commands) == 1 and not other.registered_groups and not other.registered_callback:
        (command,) = other.registered_commands
        command.name = name
        app.registered_commands.append(command)
    else:
        app.add_typer(other, name=name)


def main() -> None:
    """The console script."""
    processes.become_subreaper()
    _add_commands_of_other_rooms(sys.argv[1:])
    run_app(app)


if __name__ == "__main__":
    main()
