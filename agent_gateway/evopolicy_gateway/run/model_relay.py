"""The relay of one run: its order, its process, which is started again when it dies, and the address and token for the
agent.

It is a child of the command that plays the run and not of the agent's supervisor, which ends all that is below it and
holds no credentials. The command keeps the listening socket, so that a relay that is started again has its address.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import socket
import sys
import sysconfig
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec

import evopolicy_common
import evopolicy_gateway
from evopolicy_common.errors import EvopolicyError
from evopolicy_common.messages.operator import CreateRun
from evopolicy_common.processes.preflight import LOOPBACK
from evopolicy_common.records.secrets import Redaction, without_keys
from evopolicy_common.terminal import counted
from evopolicy_common.wire.http import bound
from evopolicy_gateway.agent_supervisor.supervisor import secrets_in
from evopolicy_gateway.http.server import Address
from evopolicy_gateway.inputs import own_config
from evopolicy_gateway.jail.view import confined
from evopolicy_gateway.processes.agent_process import environment_of
from evopolicy_gateway.processes.child_messages import (
    AgentDoing,
    Child,
    ModelBudgetSpent,
    Ready,
    RelayAddress,
    StartRelay,
)
from evopolicy_gateway.relay.limits import read_ledger
from evopolicy_gateway.relay.service import RelaySetup
from evopolicy_gateway.run import recorded_agent
from evopolicy_gateway.run.children import RestartedChild, RunContext
from evopolicy_gateway.run.plan import Replays
from evopolicy_gateway.run_folder.layout import saved
from evopolicy_gateway.workspace import staging as workspace

_MAX_DEATHS = 20
_PAUSE_S = 0.2


class ModelRelay(RestartedChild):
    """The relay of one run, from `serve` to `end`."""

    def __init__(
        self, run: RunContext, order: RelaySetup, sock: socket.socket, spent: Callable[[str], None]
    ) -> None:
        """`sock`: bound to the relay's address. `spent` gets the limit beyond which it has refused a request."""
        super().__init__(run)
        self._sock, self._spent = sock, spent
        # Connections queue here while a relay is started.
        sock.listen(64)
        self.port = sock.getsockname()[1]
        self.address = RelayAddress(url=f"http://{LOOPBACK}:{self.port}", token=order.token)
        written = [Path(order.ledger)]
        written[0].parent.mkdir(parents=True, exist_ok=True)
        written[0].touch(mode=0o600)
        if order.record != "off":
            written.append(Path(order.folder))
            written[1].mkdir(mode=0o700, parents=True, exist_ok=True)
        read = [Path(order.replay)] if order.replay else []
        self._program = _program(sock.fileno(), read, written, run.plan.jail.mode != "none")
        self._order = StartRelay(order=msgspec.to_builtins(order))

    async def serve(self) -> None:
        """Runs the relay until this is cancelled. Raises EvopolicyError when it cannot stay alive."""
        log, keeps = self._run.folder.harness_log, (self._sock.fileno(),)
        for _ in range(_MAX_DEATHS):
            self._child = await Child.start(self._program, log, talks=True, keeps=keeps)
            await self._child.tell(self._order)
            async for event in self._child.events():
                if isinstance(event, AgentDoing):
                    self._run.watch.doing(self._run.plan.name, event)
                elif isinstance(event, ModelBudgetSpent):
                    self._spent(event.what)
            await self._child.ended()
            await asyncio.sleep(_PAUSE_S)
        raise EvopolicyError(f"the relay for model calls died {_MAX_DEATHS} times; see {log}")

    async def end(self, grace_s: float) -> None:
        self._sock.close()
        if self._child is not None:
            # SIGTERM ends its jail with everything in it. It counts the answers that still come, and ends.
            await self._child.finish(grace_s)
        await super().end(grace_s)
        plan, used = self._run.plan, read_ledger(self._run.folder.model_requests)
        config = plan.known_config
        tokens = used.recorded(None if config is None else config.prices)
        n = counted(used.requests, "request")
        self._run.note(f"model use: {n} ({used.failed:,} failed), {use_words(tokens)}")


def use_words(tokens: Mapping[str, object]) -> str:
    """Tokens by kind and their cost, in the form of `run.json`, for people."""
    kinds = ", ".join(f"{name.replace('_', ' ')} {n:,}" for name, n in tokens.items() if name != "cost")
    price = f"{tokens['cost']:,.2f} dollars" if "cost" in tokens else "no prices known"
    return f"tokens: {kinds}; {price}"


def of_run(run: RunContext, ready: Ready, model_spent: asyncio.Event) -> ModelRelay | None:
    """The relay for the agent's model, None without one. It sets `model_spent` when it refuses a request."""
    plan, folder, replays = run.plan, run.folder, run.plan.replays
    terms = plan.harness().model
    if terms is None:
        return None
    if terms.upstream is None:
        how = "counted by the agent itself, so that only its tokens are limited"
        run.note(f"model limits: {terms.limits}; metering: agent ({how})")
        return None
    run.note(f"model limits: {terms.limits}; metering: relay")
    service = saved(folder.service, Address)
    port, token = (0, secrets.token_hex(24)) if replays is None else (replays.model_port, replays.model_token)

    def spent(what: str) -> None:
        if not model_spent.is_set():
            run.note(f"the model budget is spent: {what}" if replays is None else f"the replay ends: {what}")
        model_spent.set()

    order = RelaySetup(
        **msgspec.structs.asdict(terms),
        token=token,
        ledger=str(folder.model_requests),
        record=plan.record_model,
        replay="" if replays is None else str(replays.folder),
        folder=str(folder.model_record),
        tokens=(service.token, token),
        secrets=_secrets(run, ready),
    )
    made = ModelRelay(run, order, bound(LOOPBACK, port), spent)
    # A replay needs the jail, for its paths; and an agent without one could read this file.
    if plan.record_model == "full" and plan.jail.mode != "none":
        kept = Replays(
            folder=folder.model_record,
            root=folder.root,
            run=run.run,
            key=saved(folder.intended, CreateRun).key,
            port=service.port,
            token=service.token,
            model_port=made.port,
            model_token=token,
        )
        recorded_agent.keep(folder, plan, kept)
    return made


def _secrets(run: RunContext, ready: Ready) -> tuple[str, ...]:
    """Texts that the record of model calls leaves out, as the agent's log does."""
    plan, harness, config = run.plan, run.plan.harness(), run.plan.known_config
    variables = environment_of({**ready.variables, **workspace.variables(run.folder)})
    on_command_line: list[str] = []
    without_keys([plan.agent, msgspec.to_builtins(config)], on_command_line)
    in_variables = Redaction.of(secrets_in(variables, config), ready.variables).secrets
    return (*in_variables, *on_command_line, *own_config.secrets(harness.own_files))


def _program(fd: int, more: list[Path], written: list[Path], jailed: bool) -> list[str]:
    python = [sys.executable, "-P", "-m", "evopolicy_gateway.relay", str(fd)]
    if not jailed:
        return python
    places = [sys.base_prefix, os.path.realpath(sys.base_prefix), sys.prefix, sysconfig.get_path("platlib")]
    places += [*evopolicy_common.__path__, *evopolicy_gateway.__path__]
    read = [Path(place) for place in dict.fromkeys(places) if not place.startswith("/usr")] + more
    return [*confined(read, written), "--", *python]
