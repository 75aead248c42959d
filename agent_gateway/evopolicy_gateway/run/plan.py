"""A run to be played: its settings, its agent and its folder."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import DECODE_ERRORS, ConfigError, EvopolicyError, ProtocolError, raised_as
from evopolicy_common.messages.environment import StepLimit
from evopolicy_common.messages.operator import CreateRun
from evopolicy_common.messages.run_settings import RunSettings, Start
from evopolicy_common.processes.preflight import check_installed, check_loopback, check_text, check_writable
from evopolicy_common.processes.scratch import remove_tree
from evopolicy_common.records.model_record import Level
from evopolicy_common.records.policies import trees
from evopolicy_common.records.policies.trees import Tree
from evopolicy_common.records.run_files import read_record
from evopolicy_common.records.run_record import AgentInput, AgentLimits, inputs_digest
from evopolicy_common.regular_files import read_given
from evopolicy_gateway import harnesses, shipped
from evopolicy_gateway.harnesses.coding_agents import llm
from evopolicy_gateway.harnesses.interface.agent_config import USUAL_COST, AgentConfig
from evopolicy_gateway.harnesses.interface.base import Harness
from evopolicy_gateway.inputs import declared as inputs
from evopolicy_gateway.jail.settings import JailSettings
from evopolicy_gateway.processes.clock import SILENCE_S
from evopolicy_gateway.relay.usage import Prices
from evopolicy_gateway.run_folder.layout import RunFolder, run_folder, save, saved
from evopolicy_gateway.run_folder.listener import Listener, check_agent
from evopolicy_gateway.run_folder.locks import check_free
from evopolicy_gateway.workspace import prompts as workspace_prompts
from evopolicy_gateway.workspace.agents_md import PLACEHOLDERS
from evopolicy_gateway.workspace.prompts import Prompts, read_text


class Texts(msgspec.Struct, frozen=True, kw_only=True):
    agents_md: str = ""
    """In place of `AGENTS.md`; empty: the standard text."""
    prompts: Prompts = Prompts()
    inputs: tuple[AgentInput, ...] = ()
    """Skills and MCP servers."""

    @property
    def digests(self) -> dict[str, Any]:
        """By their names in `RunSettings`: SHA-256, hex; empty for a standard text."""
        text = hashlib.sha256(self.agents_md.encode()).hexdigest() if self.agents_md else ""
        return {"agents_md": text, "prompts": self.prompts.digest, "inputs": inputs_digest(self.inputs)}


def read_texts(
    agents_md: str | Path | None, prompts: str | Path | None, config: AgentConfig | None, started_in: Path
) -> Texts:
    """The texts in these files; without `prompts` those of `config`. ConfigError names the file."""
    text, chosen = "", (None if config is None else config.prompts) or Prompts()
    if agents_md is not None:
        path = shipped.found(agents_md, started_in)
        text = read_text(path)
        workspace_prompts.check_text(str(path), text, PLACEHOLDERS)
    if prompts is not None:
        path = shipped.found(prompts, started_in)
        with raised_as(ConfigError, path, *DECODE_ERRORS):
            chosen = msgspec.toml.decode(read_text(path), type=Prompts)
        chosen.check(str(path))
    declared = () if config is None else inputs.read_inputs(config.skills, config.mcp, started_in)
    return Texts(agents_md=text, prompts=chosen, inputs=tuple(each.recorded for each in declared))


def read_prices(file: str | Path | None, config: AgentConfig | None, started_in: Path) -> Prices | None:
    """Prices of the agent's model in a file; None without file or settings. ConfigError names the file."""
    if file is None or config is None:
        return None
    path = shipped.found(file, started_in)
    with raised_as(ConfigError, f"--set prices={path}", msgspec.DecodeError, UnicodeDecodeError):
        tables = msgspec.toml.decode(read_given(path, f"--set prices={path}"), type=dict[str, Prices])
    if config.model is None:
        raise ConfigError(
            f"--set prices={path}: the agent's model is not named; write it as in codex:gpt-5.5, or in its file"
        )
    if config.model not in tables:
        raise ConfigError(
            f'--set prices={path} has no prices for {config.model}: add a table ["{config.model}"] with input and'
            " output, in US dollars per million tokens"
        )
    return tables[config.model]


WALL_S = 12 * 3600.0
"""Default wall limit of an agent, seconds."""
_OPERATIONAL = frozenset(
    ("retries", "backoff_s", "silence_s", "pause_s", "max_pause_s", "pass_environment", "prices")
)
"""Settings of a coding agent that do not affect the run's measurements."""


class Replays(msgspec.Struct, frozen=True, kw_only=True):
    """The run whose agent is played again: its record, and the places of its agent's workspace and services."""

    folder: Path
    """Of the record of model calls."""
    root: Path
    """The run's folder, as its agent saw it."""
    run: str
    """The coordinator's name of the run."""
    key: str
    """With which the run was created: shows the coordinator that its own operator replays it."""
    port: int
    """Of the run's service."""
    token: str
    model_port: int
    model_token: str


class Plan(msgspec.Struct, frozen=True, kw_only=True):
    """A run to be played, alone or as part of a sweep."""

    name: str = ""
    """The run's name in messages, unique within a command: its environment, in a sweep `agent/environment/repeat`."""
    settings: RunSettings
    agent: str
    """In the form of `--agent`."""
    runs: Path
    started_in: Path
    wall_limit_s: float
    silence_s: float = SILENCE_S
    """A program without activity for this long is ended, seconds."""
    overwrite: bool = False
    resume: bool = False
    """Whether to resume the run that the folder holds."""
    config: AgentConfig | None = None
    """A coding agent's settings, from a suite's file."""
    prices: Prices | None = None
    """In place of those in the settings."""
    texts: Texts = Texts()
    """`settings` has their digests."""
    parallel: int | None = None
    """Maximum number of simultaneous runs of its entry; None: no limit of its own."""
    jail: JailSettings = JailSettings()
    limits: AgentLimits = AgentLimits()
    start_from: str = ""
    """`RUN@submit_NNN` with an absolute path, as `settings.start` names it; empty: the usual workspace."""
    record_model: Level = "digests"
    """How much of the calls of its model is recorded."""
    replays: Replays | None = None
    """The recorded run whose agent is played again; None: its model answers."""
    listener: Listener | None = None
    """The address that serves a remote agent; None for an agent that is started here."""

    @property
    def folder(self) -> RunFolder:
        return run_folder(self.runs, self.settings.entry, self.settings.env, self.settings.exp_id)

    @property
    def entry(self) -> str:
        return self.settings.entry

    @property
    def known_config(self) -> AgentConfig | None:
        """A coding agent's settings with the operator's or the provider's prices, and with the usual limit of the cost:
        where there are prices, and not in a published profile."""
        config = self.config or harnesses.config_of(self.agent, self.started_in)
        if config is None:
            return None
        prices = self.prices or llm.prices_of(config)
        usual = USUAL_COST if prices is not None and self.settings.profile == "own" else None
        return msgspec.structs.replace(config, prices=prices, max_cost=config.max_cost or usual)

    def harness(self) -> Harness:
        """The agent's harness. Raises ConfigError for an invalid agent."""
        return harnesses.make(self.agent, self.started_in, self.known_config)

    @property
    def provider(self) -> str:
        """Name of the agent's model provider; while a provider is away its runs wait together."""
        return self.config.provider_name if self.config is not None else self.agent.partition(":")[0]

    @property
    def defining(self) -> dict[str, Any]:
        """Everything that identifies this run; the attempt and operational settings do not.

        Settings at their default are left out, so that a setting added by a later version does not change a run's
        identity.
        """
        config = None
        if self.config is not None:
            unusual = _unusual(msgspec.to_builtins(self.config), msgspec.to_builtins(AgentConfig(harness="")))
            config = {name: value for name, value in unusual.items() if name not in _OPERATIONAL}
        settings = self.settings
        # Without a published limit both kinds of step limit are equal.
        both = catalogue.entry(settings.env).published_steps is not None
        limit: StepLimit = "natural" if both else settings.step_limit
        usual = RunSettings(env="", entry="", model="", exp_id="", attempt=settings.attempt, step_limit=limit)
        unusual = _unusual(msgspec.to_builtins(settings), msgspec.to_builtins(usual))
        unusual.pop("replays", None)  # videos are recorded after the run and do not affect it
        identity = {
            "agent": self.agent,
            "config": config,
            "settings": unusual,
            "agent_wall_s": self.wall_limit_s,
        }
        if self.silence_s != SILENCE_S:
            identity["agent_silence_s"] = self.silence_s
        if unusual := _unusual(msgspec.to_builtins(self.limits), msgspec.to_builtins(AgentLimits())):
            identity["agent_limits"] = unusual
        # The jail's `read` names the places of programs, which differ from host to host.
        reached = {name: value for name, value in self.jail.chosen().items() if name != "read"}
        if reached or self.jail.mode != JailSettings().mode:
            identity["jail"] = {"mode": self.jail.mode, **reached}
        return identity

    @property
    def digest(self) -> str:
        """First 16 hex digits of the SHA-256 of `defining`."""
        data = msgspec.json.encode(list(self.defining.values()), order="sorted")
        return hashlib.sha256(data).hexdigest()[:16]

    def check(self) -> None:
        """Raises ConfigError when the agent cannot start, or when its jail or the run's folder is not available.

        A folder that holds a run is not available unless `overwrite` or `resume` is set.
        """
        check_free(self.folder.lock, self.folder.root)
        self.check_held()

    def check_held(self) -> None:
        """`check` for the holder of the folder's lock."""
        check_text(self.started_in, "cd")
        msgspec.json.encode((self.settings, self.agent))  # UnicodeEncodeError for an option that is not UTF-8
        check_installed("gateway")
        check_writable(self.runs, "--runs")
        check_agent(self.agent, self.listener)
        if self.listener is None:
            check_loopback()
        elif self.limits != AgentLimits():
            raise ConfigError(
                "agent_cpus, agent_memory, agent_pids and agent_disk limit an agent that is started here;"
                " leave them out"
            )
        self.harness().check(self.settings.env)
        self.jail.check()
        if self.texts.inputs and self.jail.mode == "none":
            raise ConfigError("skills and [mcp] servers are shown by the agent's jail; leave out --jail none")
        folder = self.folder
        if self.start_from.rpartition("@")[0] == str(folder.root):
            raise ConfigError(f"{folder.root} cannot start from itself; choose another --exp-id")
        if not folder.root.exists():
            return
        # A command that was killed while it emptied the folder leaves any part of it, and `asked`.
        marks = (folder.run_json, folder.state, folder.asked)
        if any(folder.root.iterdir()) and not any(mark.exists() for mark in marks):
            raise ConfigError(f"{folder.root} is not a run's folder; choose another --runs or --exp-id")
        self.check_owner()
        if self.resume and (intended := self.intended()) is not None:
            if intended.settings.inputs != self.settings.inputs:
                raise ConfigError(
                    f"{folder.root} holds a run whose agent has other skills or MCP servers than are declared now:"
                    " restore their files, or start the run anew with --overwrite"
                )
            if intended.settings != self.settings:
                raise ConfigError(
                    f"{folder.root} holds a run with other settings; resume it with its original options"
                )
        elif not (self.resume or self.overwrite):
            kind, more = "an unfinished", ", or resume it with --resume"
            if folder.run_json.exists():
                kind, more = "a finished", ""
                with contextlib.suppress(OSError, ProtocolError):
                    status = read_record(folder.root).outcome.status
                    kind = {"cancelled": "a cancelled", "error": "a failed"}.get(status, kind)
            raise ConfigError(
                f"{folder.root} holds {kind} run; choose another --exp-id, or replace it with --overwrite{more}"
            )

    def check_owner(self) -> None:
        """Raises ConfigError when the folder holds a run of another entry or environment."""
        own = held = (self.entry, self.settings.env)
        if (intended := self.intended()) is not None:
            held = (intended.settings.entry, intended.settings.env)
        else:
            with contextlib.suppress(OSError, EvopolicyError):
                record = read_record(self.folder.root)
                held = (record.agent.entry, record.env)
        if held != own:
            raise ConfigError(
                f"{self.folder.root} holds a run of {held[0]!r} on {held[1]!r}, not of {own[0]!r} on {own[1]!r}: here"
                " their folders have one name. Choose another --entry, --exp-id or --runs"
            )

    def intended(self) -> CreateRun | None:
        """The request that opened the run in the folder; None when there is none."""
        with contextlib.suppress(FileNotFoundError):
            return saved(self.folder.intended, CreateRun)
        return None

    def claim(self) -> None:
        """Creates the run's private empty folder. Raises ConfigError as `check_held`."""
        self.check_held()
        if self.folder.root.exists():
            remove_tree(self.folder.root)
        self.folder.root.mkdir(mode=0o700, parents=True)


def check_apart(plans: Iterable[Plan]) -> None:
    """Raises ConfigError when two runs would share a folder, here or on a file system that ignores case."""
    known: dict[str, Plan] = {}
    for plan in plans:
        other = known.setdefault(os.fspath(plan.folder.root).casefold(), plan)
        if other is not plan:
            raise ConfigError(
                f"{other.entry!r} on {other.settings.env!r} and {plan.entry!r} on {plan.settings.env!r} would share"
                " one folder, at least where a file system ignores case; give one of them another name"
            )


def _unusual(values: dict[str, Any], usual: dict[str, Any]) -> dict[str, Any]:
    """Values that differ from the defaults, also within inner tables."""
    unusual = {name: value for name, value in values.items() if name not in usual or value != usual[name]}
    for name, value in unusual.items():
        if isinstance(value, dict) and isinstance(usual.get(name), dict):
            unusual[name] = _unusual(value, usual[name])
    return unusual


class StartPoint(NamedTuple):
    start: Start
    folder: RunFolder
    """Of the earlier run."""
    submit: str
    tree: Tree


def find_start(text: str, started_in: Path) -> StartPoint:
    """The submit that `RUN@submit_NNN` names, RUN relative to `started_in`. ConfigError that names the fault."""
    place, _, submit = text.rpartition("@")
    number = trees.submit_number(submit)
    if not place or number is None:
        raise ConfigError(
            f"--start-from {text!r}: use the form RUN@submit_NNN, such as"
            " runs/evolve/gym_acrobot/first@submit_007"
        )
    folder = RunFolder((started_in / place).absolute())
    remedy = "name a run directory"
    with raised_as(ConfigError, f"--start-from {text}: no run is there", OSError, remedy=remedy):
        # A folder of another user's making could name any run and hold any files.
        if folder.root.stat().st_uid != os.getuid():
            raise ConfigError(
                f"--start-from {text}: {folder.root} belongs to another user; name a run of your own"
            )
        finished = folder.run_json.exists()
        run = read_record(folder.root).run if finished else saved(folder.intended, CreateRun).run
    tree, digest = trees.read_tree(folder.root, submit)
    if not (folder.feedback / submit).is_dir():
        raise ConfigError(f"--start-from {text}: the submit has no feedback yet; wait until it is played")
    return StartPoint(Start(run=run, submit_index=number, tree=digest), folder, submit, tree)


def stage_start(point: StartPoint, folder: RunFolder) -> None:
    """Makes the workspace of a new run. StorageError for a missing content, and where the disk refuses."""
    start, source, submit, tree = point
    folder.workspace.mkdir()
    trees.restore(source.root, tree, folder.workspace)
    omitted = trees.copy_history(source.feedback, source.history, start.submit_index, folder.history)
    folder.history.mkdir(exist_ok=True)
    about = {"submit": submit, "omitted": omitted}
    (folder.history / "START.json").write_bytes(msgspec.json.format(msgspec.json.encode(about)) + b"\n")
    save(folder.start, start)
