"""Options that several commands share, and how their values become settings. A wrong value is a ConfigError."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, get_args

import msgspec
import typer
from rich.console import Console

from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError, RequestError
from evopolicy_common.messages.environment import ObservationForm, PolicyScope
from evopolicy_common.messages.episode import ResourceLimits, Tier
from evopolicy_common.messages.gateway import VideoOption
from evopolicy_common.messages.operator import RunSettings
from evopolicy_gateway.door import Door, door_of
from evopolicy_gateway.jail.settings import JailSettings, Mode, absolute
from evopolicy_gateway.submit_request import Bounds, ids_in

Connect = Annotated[
    list[str] | None,
    typer.Option(help="Endpoint of the coordinator, such as tls/10.0.0.5:7447; may be repeated."),
]
CredentialsFile = Annotated[
    Path | None,
    typer.Option(
        "--credentials",
        help="Folder of `evopolicy-coordinator certs issue operator`, or the coordinator's STATE/credentials.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON; progress goes to stderr.")]
Slots = Annotated[int, typer.Option(min=1, max=1024, help="Episodes at once of the local worker.")]
AgentName = Annotated[
    str,
    typer.Option(
        help="evolve, random, replay:DIR, command:PROGRAM…, codex, claude-code, file:AGENT.toml, remote",
        show_default=False,
    ),
]
Limits = Annotated[
    list[str] | None,
    typer.Option(
        "--limit", help="A policy's limit, such as act_wall_s=5 or memory_bytes=2e9; may be repeated."
    ),
]
DataFolder = Annotated[
    Path | None,
    typer.Option(
        help="Folder of split files (`evopolicy data make`); default: derived from the state's secret."
    ),
]
JailMode = Annotated[
    str,
    typer.Option(
        "--jail",
        help="Around the agent: bwrap, open-network (jailed, with this machine's network), none. Recorded in run.json.",
    ),
]
JailBind = Annotated[
    list[str] | None,
    typer.Option("--jail-bind", help="File or folder that the agent sees, read-only; may be repeated."),
]
JailBindWritable = Annotated[
    list[str] | None, typer.Option("--jail-bind-rw", help="File or folder that it may also change.")
]
JailVariable = Annotated[
    list[str] | None,
    typer.Option("--jail-env", help="Variable that is passed on to it, such as an API key's."),
]
AllowHost = Annotated[
    list[str] | None,
    typer.Option(help="HOST or HOST:PORT that it reaches besides its harness's own; may be repeated."),
]
Http = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT",
        help="With --agent remote: the address of this machine on which the agent is served; every request needs the token.",
    ),
]
HttpUrl = Annotated[
    str | None,
    typer.Option(help="How the agent reaches it where that is another URL, such as that of a TLS front."),
]
StateFolder = Annotated[
    Path | None, typer.Option(help="Keep the coordinator's state here; default: thrown away at the end.")
]

Audit = Annotated[
    float,
    typer.Option(
        min=0.0,
        max=1.0,
        metavar="SHARE",
        help="Share of the episodes that a second local worker plays again from their actions, compared bit for bit.",
    ),
]


class RunOptions(msgspec.Struct, frozen=True, kw_only=True):
    """What `run` and `local` take for each run, as given."""

    agent: str
    entry: str
    model: str | None
    exp_id: str | None
    repeat: int
    budget: int | None
    min_episodes: int | None
    max_episodes: int | None
    validation: int | None
    heldout: int | None
    policy_scope: str
    observations: str
    tier: str
    video: str
    replays: str | None = None
    limits: Sequence[str]

    def settings(self, env: str, exp_id: str) -> RunSettings:
        """The settings of one run. ConfigError naming the option that is wrong."""
        return RunSettings(
            env=env,
            entry=self.entry,
            model=self.model or self.entry,
            exp_id=exp_id,
            repeat=self.repeat,
            budget=self.budget,
            min_episodes_per_submit=self.min_episodes,
            max_episodes_per_submit=self.max_episodes,
            n_validation=self.validation,
            n_heldout=self.heldout,
            policy_scope=_one_of("--policy-scope", self.policy_scope, PolicyScope),  # type: ignore[arg-type]
            observations=_one_of("--observations", self.observations, ObservationForm),  # type: ignore[arg-type]
            sandbox_tier=tier_of(self.tier),
            video=_one_of("--video", self.video, VideoOption),  # type: ignore[arg-type]
            replays=None if self.replays is None else _one_of("--replays", self.replays, VideoOption),  # type: ignore[arg-type]
            limits=limits_of(self.limits),
        )


def jail_of(
    mode: str,
    read: Sequence[str] | None,
    write: Sequence[str] | None,
    variables: Sequence[str] | None,
    hosts: Sequence[str] | None,
) -> JailSettings:
    """The jail that the options ask for. ConfigError naming the one that is wrong, or what this machine lacks."""
    started_in = Path.cwd()
    settings = JailSettings(
        mode=_one_of("--jail", mode, Mode),  # type: ignore[arg-type]
        read=tuple(absolute(path, started_in) for path in read or ()),
        write=tuple(absolute(path, started_in) for path in write or ()),
        environment=tuple(variables or ()),
        hosts=tuple(hosts or ()),
    )
    settings.check()
    return settings


def no_jail_of_ours(mode: str, *widened: Sequence[str] | None) -> JailSettings:
    """The jail of an agent that somebody else starts: none of ours. ConfigError when one is asked for."""
    if mode == "open-network" or any(widened):
        raise ConfigError("--agent remote is not started here, so --jail and its options do not go with it")
    return JailSettings(mode="none")


def door_from(http: str | None, url: str | None) -> Door | None:
    """Where a remote agent is served. ConfigError naming the option that is wrong."""
    if http is None and url is not None:
        raise ConfigError("--http-url tells how --http HOST:PORT is reached; it needs that")
    return None if http is None else door_of(http, url)


def console(*, stderr: bool) -> Console:
    """For people: as wide as their terminal, and wide enough for a table where there is none."""
    found = Console(stderr=stderr)
    return found if found.is_terminal else Console(stderr=stderr, width=160)


def tier_of(text: str) -> Tier:
    return _one_of("--tier", text, Tier)  # type: ignore[return-value]


def default_exp_id() -> str:
    """From the time, so that every run has a folder of its own."""
    return time.strftime("%Y%m%d-%H%M%S")


def one_environment(env: str) -> str:
    """The suite id that `env` names. ConfigError when it names none or several."""
    found = catalogue.resolve([env])
    if len(found) != 1:
        raise ConfigError(f"--env {env} names {len(found)} environments; this command takes one")
    return found[0]


def limits_of(texts: Sequence[str]) -> ResourceLimits:
    """`NAME=VALUE` texts over the usual limits."""
    usual = ResourceLimits()
    values: dict[str, float | int] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        known = ", ".join(usual.__struct_fields__)
        if not equals or name not in usual.__struct_fields__:
            raise ConfigError(f"--limit {text!r}: say it as NAME=VALUE; names are {known}")
        try:
            number = float(value)
        except ValueError:
            raise ConfigError(f"--limit {text!r}: {value!r} is no number") from None
        if not 0 < number < float("inf"):
            raise ConfigError(f"--limit {text!r}: a limit is a finite number above zero")
        values[name] = int(number) if isinstance(getattr(usual, name), int) else number
    return msgspec.structs.replace(usual, **values)


def cases_of(text: str) -> tuple[int, ...]:
    """Case ids of a text such as `0-3,7`."""
    # How many cases there are, the coordinator knows; here only nonsense is kept out.
    bounds = Bounds(n_env_instances=10**6, min_episodes=1, max_episodes=4096, remaining_budget=4096)
    try:
        ids = ids_in(text, bounds)
    except RequestError as error:
        raise ConfigError(f"--cases {text!r}: {error.message.replace('env_instances', 'it')}") from error
    if not ids:
        raise ConfigError(f"--cases {text!r} names no case; say it as 0-3,7")
    return ids


def _one_of(option: str, text: str, kind: object) -> str:
    allowed = get_args(kind)
    if text not in allowed:
        raise ConfigError(f"{option} {text!r}: there are {', '.join(allowed)}")
    return text
