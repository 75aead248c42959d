"""A coding agent's CLI as an agent: one logical session over many turns, through failures, outages and restarts.

Rules:
- After a failure the same session is resumed, at most `retries` times in a row, each time after a longer back-off. This
  affects neither the environment nor the budget.
- A longer outage of the provider, or an exhausted quota, pauses the run instead; the agent's clock pauses meanwhile.
- An agent that stops with budget left is reminded of it, at most `reprompts` times.
- A cap on tokens or money ends the agent, also within a turn if its stream reports usage.
"""

from __future__ import annotations

import asyncio
import os
import random
import shutil
import subprocess
import uuid
from collections.abc import Mapping
from typing import Any, Literal

import msgspec

from evopolicy_common.errors import ConfigError, EvopolicyError
from evopolicy_common.logs import log
from evopolicy_gateway.harnesses.coding_agents import session
from evopolicy_gateway.harnesses.coding_agents.dialect import Dialect, TurnReader, first_line
from evopolicy_gateway.harnesses.coding_agents.session import SessionState
from evopolicy_gateway.harnesses.coding_agents.turn import Capped, play_turn
from evopolicy_gateway.harnesses.coding_agents.turn_failure import TurnFailure, backoff_s
from evopolicy_gateway.harnesses.interface.agent_config import relay_variables
from evopolicy_gateway.harnesses.interface.base import AgentError, Harness, Stage
from evopolicy_gateway.inputs import own_config
from evopolicy_gateway.inputs.kept import KeptInputs
from evopolicy_gateway.processes.child_messages import AgentDoing, AgentEnded, RelayAddress
from evopolicy_gateway.relay.limits import ModelTerms
from evopolicy_gateway.relay.usage import Usage
from evopolicy_gateway.workspace import prompts

_PROBE_TIMEOUT_S = 60.0
_MAX_PAUSE_S = 3600.0
_IN_FLIGHT_PAUSE_S = 0.5
_MAX_FAULTY = 2


class CliAgent(Harness):
    """Runs any CLI that has a `Dialect`."""

    def __init__(self, dialect: Dialect) -> None:
        self.name = dialect.name
        self.resumable = dialect.resumes
        self._dialect = dialect
        self._config = dialect.config
        self._program = list(self._config.program or dialect.program)
        self.command = self._program
        self.variables = self._config.pass_environment
        self.packages = dialect.packages
        self.hosts = tuple(host for server in self._config.mcp.values() for host in server.hosts)
        self.own_files = own_config.places(self._config.user_config, self._program[0])
        self.skills_at = self._config.skills_at or dialect.skills_at
        self.model = ModelTerms(
            limits=self._config.limits,
            prices=self._config.prices,
            model=self._config.model,
            declared_only=self._config.models == "declared",
            own_tools_only=self._config.hosted_tools == "refuse",
            upstream=self._config.upstream(os.environ),
        )
        self._options = ""
        self._version: str | None = None
        self._state = SessionState()
        self._failures = 0
        """Failed turns since the last completed one."""
        self._faulty = 0
        """Turns in a row that ended by faulty answers."""
        self._pause_s = self._config.pause_s

    def take_inputs(self, kept: KeptInputs) -> None:
        self._dialect.kept = kept

    def check(self, env: str) -> None:
        self._check_program(os.environ | self._dialect.environment() | self._config.environment, ConfigError)

    async def run_agent(self, stage: Stage) -> AgentEnded:
        self._config.check(stage.environment)
        own = self._dialect.environment() | self._config.environment
        stage = msgspec.structs.replace(stage, environment={**stage.environment, **own})
        if self.relay is not None:
            stage = self._relayed(stage, self.relay)
        await self._probe(stage)
        self._state = session.load(stage.session_file)
        self._keep(stage)
        then = await self._prompt_after_failure(stage)
        while not isinstance(then, AgentEnded):
            reader = await self._turn(stage, then)
            if stage.over.is_set():
                return self._ending()
            then = await (self._done(stage, reader) if reader.done else self._failed(stage, reader))
            if stage.over.is_set() and not isinstance(then, AgentEnded):
                return self._ending()
        return then

    def _relayed(self, stage: Stage, relay: RelayAddress) -> Stage:
        """The stage with the relay's address and token in place of the provider's and the key."""
        upstream = self._config.upstream(os.environ)
        assert upstream is not None
        self._dialect.relay = relay
        key = upstream.key
        kept = {name: value for name, value in stage.environment.items() if not (key and key in value)}
        stage.log.redact = stage.log.redact.knowing([key, relay.token])
        if self._dialect.takes_variables:
            kept |= relay_variables(upstream.protocol, relay.url, relay.token)
        return msgspec.structs.replace(stage, environment=kept)

    async def _turn(self, stage: Stage, prompt: str) -> TurnReader:
        dialect, state = self._dialect, self._state
        if stage.tells_left:
            n_tokens = max(0, self._config.limits.max_tokens - state.usage.total)
            prompt += prompts.left(stage.clock.remaining_s(), n_tokens)
        resume = state.session is not None and dialect.resumes
        begun = state.session if resume else str(uuid.uuid4()) if dialect.makes_session_id else None
        stage.log.note({"type": "prompt", "turn": state.turns, "session": begun, "message": prompt})
        reader = dialect.reader()
        # A cumulative stream repeats the usage of this session's earlier turns, so these are not added again.
        counted = (used for one, used in state.used.items() if not dialect.cumulative or one != begun)
        spent = sum(counted, Usage())
        reported = Usage()

        def capped(now: TurnReader) -> str | None:
            nonlocal reported
            if now.usage.total > reported.total:
                reported = now.usage
                stage.on_doing(AgentDoing(tokens=(spent + reported).recorded(self._config.prices)))
            return self._capped(spent + now.usage)

        await self._play_turn(stage, begun, prompt, reader, capped)
        known = reader.session or begun
        state.add_usage(known or "", reader.usage, cumulative=dialect.cumulative)
        if known is not None and (reader.session is not None or reader.done):
            state.session = known
        state.requests_failed += reader.requests_failed
        self._keep(stage)
        return reader

    async def _play_turn(
        self, stage: Stage, session: str | None, prompt: str, reader: TurnReader, capped: Capped
    ) -> None:
        """Plays the turn into the reader. `session`: to be resumed or, where we generate its id, begun."""
        dialect = self._dialect
        resume = self._state.session is not None and dialect.resumes
        arguments = dialect.arguments(session, resume=resume, prompt=prompt, options=self._options)
        program = [*self._program, *arguments]
        await play_turn(stage, dialect, program, prompt, reader, capped)

    async def _done(self, stage: Stage, reader: TurnReader) -> AgentEnded | str:
        """The next prompt after a completed turn, or the end."""
        state = self._state
        state.turns += 1
        self._failures, self._faulty, self._pause_s = 0, 0, self._config.pause_s
        self._keep(stage)
        stage.on_turn(state.turns, stage.log.redact.text(reader.text))
        if (why := self._capped(state.usage)) is not None:
            return self._ending("agent_stopped", why)
        n_left = await episodes_left(stage)
        if n_left == 0 or stage.over.is_set():
            return self._ending()
        if state.reprompts >= self._config.reprompts:
            remaining = "budget" if n_left is None else f"{n_left} episodes"
            why = f"stopped with {remaining} left after {state.reprompts} reminders"
            return self._ending("agent_stopped", why)
        state.reprompts += 1
        self._keep(stage)
        return stage.prompts.stopped(n_left) if self._dialect.resumes else stage.prompts.begin()

    async def _failed(self, stage: Stage, reader: TurnReader) -> AgentEnded | str:
        """Waits as the failure requires and returns the prompt of the retry, or the end."""
        state, config = self._state, self._config
        failure = reader.failure or TurnFailure(kind="passing", message="the program ended without a word")
        message = stage.log.redact.text(failure.message)
        log.warning("turn failed", kind=failure.kind, message=message, failures=self._failures + 1)
        stage.log.note({"type": "turn_failed", "kind": failure.kind, "message": failure.message})
        if failure.kind in ("final", "cap"):
            return self._ending("agent_failed" if failure.kind == "final" else "agent_stopped", message)
        self._faulty = self._faulty + 1 if failure.kind == "faulty" else 0
        if self._faulty >= _MAX_FAULTY:
            return self._ending("agent_failed", f"{self._faulty} turns in a row ended by {message}")
        self._failures += 1
        if failure.kind == "lost":
            state.session = None
        if failure.kind == "quota" or (failure.provider and self._failures > config.retries):
            if state.paused_s >= config.max_pause_s:
                return self._ending("agent_failed", f"paused for {state.paused_s:.0f} s in all: {message}")
            await self._pause(stage, failure, message)
        elif self._failures > config.retries:
            return self._ending("agent_failed", f"failed {self._failures} times in a row: {message}")
        elif failure.kind != "lost":
            wait_s = backoff_s(self._failures, config.backoff_s, random.random())
            wait_s = max(wait_s, min(failure.wait_s or 0.0, _MAX_PAUSE_S))
            told = f"retry {self._failures} in {wait_s:.0f} s: {message}"
            stage.on_doing(AgentDoing(action=told, note=told if self._failures == 1 else ""))
            await stage.sleep(wait_s)
        state.retries += 1
        self._keep(stage)
        return await self._prompt_after_failure(stage)

    async def _pause(self, stage: Stage, failure: TurnFailure, message: str) -> None:
        """Waits for the provider, with the agent's clock paused."""
        state, config = self._state, self._config
        wait_s = self._pause_s if failure.wait_s is None else failure.wait_s
        wait_s = min(wait_s * random.uniform(1.0, 1.1), max(0.0, config.max_pause_s - state.paused_s))
        self._pause_s = min(2.0 * self._pause_s, max(_MAX_PAUSE_S, config.pause_s))
        # Only a completed turn resets the retries: until then, one attempt per pause.
        self._failures = max(self._failures, config.retries)
        stage.log.note({"type": "paused", "seconds": round(wait_s, 1), "message": message})
        paused = AgentDoing(action=f"paused: {message}", paused_s=wait_s, provider=config.provider_name)
        stage.on_doing(paused)
        with stage.clock.paused():
            await stage.sleep(wait_s)
        state.paused_s += wait_s
        stage.on_doing(AgentDoing(action="tries again", provider=config.provider_name))

    async def _prompt_after_failure(self, stage: Stage) -> AgentEnded | str:
        """The first prompt of a session, or the prompt that resumes an interrupted one; the end if the budget is
        spent."""
        if (n_left := await episodes_left(stage)) == 0:
            return self._ending()
        if self._state.session is None or not self._dialect.resumes:
            return stage.prompts.begin()
        return stage.prompts.resumed(n_left)

    def _keep(self, stage: Stage) -> None:
        self._state.cli_version = self._version
        session.save(stage.session_file, self._state)
        stage.on_doing(AgentDoing(tokens=self._state.usage.recorded(self._config.prices)))

    def _capped(self, used: Usage) -> str | None:
        config = self._config
        if self.relay is not None:
            return None  # which counts more exactly
        if used.total > config.limits.max_tokens:
            return f"cap reached: {used.total} tokens of {config.limits.max_tokens} used"
        cost = 0.0 if config.prices is None else used.cost(config.prices)
        if config.max_cost is not None and cost > config.max_cost:
            return f"cap reached: {cost:.2f} of {config.max_cost:.2f} dollars spent"
        return None

    def _check_program(self, environment: Mapping[str, str], wrong: type[EvopolicyError]) -> None:
        name, install = self._program[0], self._dialect.install
        if shutil.which(name, path=environment.get("PATH")) is None:
            advice = f"; install it with: {install}" if install else ""
            raise wrong(f"there is no program {name!r} on the PATH{advice}")

    async def _probe(self, stage: Stage) -> None:
        """Finds the program, its version and its options. Raises AgentError that names what is missing."""
        name, dialect = self._program[0], self._dialect
        self._check_program(stage.environment, AgentError)
        self._version = dialect.version_in(await self._ask(stage, dialect.version_args))
        if not dialect.help_args:
            return
        version = self._version or "of an unknown version"
        self._options = await self._ask(stage, dialect.help_args)
        missing_options = [option for option in dialect.required_options() if option not in self._options]
        if missing_options:
            raise AgentError(
                f"{name} {version} has no {', '.join(missing_options)};"
                f" known to work: {dialect.tested_version} ({dialect.install}@{dialect.tested_version});"
                f" its help begins: {first_line(self._options) or '(empty)'}"
            )
        if self._version != dialect.tested_version:
            note = f"{name} {version} is used; tested was {dialect.tested_version}"
            log.warning("another version than the tested one", version=version, tested=dialect.tested_version)
            stage.on_doing(AgentDoing(note=note))

    async def _ask(self, stage: Stage, arguments: tuple[str, ...]) -> str:
        words = [*self._program, *arguments]

        def run() -> str:
            way = None if stage.jail is None else stage.jail.sealed(words)
            try:
                answer = subprocess.run(
                    words if way is None else way.words,
                    cwd=stage.workspace,
                    env=dict(stage.environment),
                    stdin=subprocess.DEVNULL,
                    capture_output=True,
                    timeout=_PROBE_TIMEOUT_S,
                    pass_fds=() if way is None else way.pass_fds,
                    check=False,
                )
            finally:
                if way is not None:
                    way.failed()
            return (answer.stdout or answer.stderr).decode("utf-8", "replace")

        try:
            return await asyncio.to_thread(run)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise AgentError(f"{self._program[0]} does not answer {' '.join(arguments)}: {error}") from error

    def known_facts(self) -> dict[str, Any]:
        settings = self._config.settings() | {"program": self._program}
        return {"harness": self.name, "model_string": self._config.model, "settings": settings}

    def _ending(
        self, reason: Literal["agent_stopped", "agent_failed"] = "agent_stopped", detail: str = ""
    ) -> AgentEnded:
        state, config = self._state, self._config
        facts = self.known_facts() | {"cli_version": self._version}
        facts["settings"] |= {"reprompted": state.reprompts, "paused_s": round(state.paused_s, 1)}
        facts["settings"]["requests_failed"] = state.requests_failed
        if self._dialect.tested_version not in ("", self._version):
            facts["settings"]["tested_version"] = self._dialect.tested_version
        if state.usage.total:
            facts["tokens"] = state.usage.recorded(config.prices)
        return AgentEnded(reason=reason, detail=detail, turns=state.turns, retries=state.retries, facts=facts)


async def episodes_left(stage: Stage) -> int | None:
    """Episodes left, once no submit is in flight; None when the gateway does not answer.

    An agent prompted while its submit runs could only answer that it waits, and would use up its reminders.
    """
    try:
        while (info := await stage.info()).get("submit_in_flight") and not stage.over.is_set():
            await stage.sleep(_IN_FLIGHT_PAUSE_S)
        state = info["state"]
        return 0 if state["is_finalized"] else int(state["remaining_budget"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
