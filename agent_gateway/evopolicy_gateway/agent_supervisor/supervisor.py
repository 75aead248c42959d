"""The agent supervisor: a process that starts one agent, watches its wall clock, and ends all its processes.

It exchanges the messages of `processes/child_messages.py` with `evopolicy run`, one per line. It is separate from the
gateway, so that an agent's parent holds no credentials, and so that a restarted gateway finds the agent still running.
"""

from __future__ import annotations

import asyncio
import fcntl
import os
import signal
import sys
from collections.abc import Collection, Mapping
from pathlib import Path

import msgspec

from evopolicy_common.cli.conventions import setup_logging
from evopolicy_common.errors import ConfigError, EvopolicyError
from evopolicy_common.logs import log
from evopolicy_common.records.secrets import Redaction, is_secret, note_passed, without_keys
from evopolicy_gateway.harnesses import config_of, make
from evopolicy_gateway.harnesses.interface.agent_config import AgentConfig
from evopolicy_gateway.harnesses.interface.base import Stage
from evopolicy_gateway.inputs import kept as inputs
from evopolicy_gateway.inputs import own_config
from evopolicy_gateway.jail.jail import Jail
from evopolicy_gateway.processes import child_messages as messages
from evopolicy_gateway.processes import trees as processes
from evopolicy_gateway.processes.agent_process import AgentLog, environment_of
from evopolicy_gateway.processes.child_messages import AgentEnded, Orders, StartAgent, emit
from evopolicy_gateway.processes.clock import Activity, AgentClock
from evopolicy_gateway.processes.resources import Resources
from evopolicy_gateway.run_folder.layout import RunFolder
from evopolicy_gateway.workspace.prompts import Prompts

END_GRACE_S = 3.0
"""Time from SIGTERM to SIGKILL."""
LAST_WORDS_S = 2.0
_TEXT_SHOWN = 2000
_LINES_SHOWN = 8
_TELL_TIME_S = 5.0
_SURVIVORS_PAUSE_S = 1.0


async def keep(order: StartAgent, orders: Orders) -> AgentEnded:
    """Runs the agent until it ends, is stopped, or its time is up; afterwards none of its processes remains."""
    environment = environment_of({**order.urls, **order.variables})
    try:
        if order.config is None:
            config = config_of(order.agent, Path(order.started_in))
        else:
            config = msgspec.convert(order.config, AgentConfig)
    except ConfigError as error:
        # The agent's file has changed since the run was opened.
        return AgentEnded(reason="agent_failed", detail=str(error))
    on_command_line: list[str] = []
    shown = without_keys([order.agent, msgspec.to_builtins(config)], on_command_line)[0]
    redact = Redaction.of(secrets_in(environment, config), order.urls).knowing(on_command_line)
    folder = RunFolder(Path(order.folder))
    agent_log = AgentLog(folder.agent_log, redact)
    clock = AgentClock(order.wall_limit_s)
    workspace, folders = folder.workspace, [folder.workspace]
    if order.jail is not None:
        folders += [Path(order.jail.private, name) for name in ("home", "tmp")]
    # Binds this process to cores, or makes the agent's cgroup.
    resources = Resources(order.limits, folders, workspace / "feedback", jailed=order.jail is not None)
    if words := resources.limits_text():
        emit(messages.AgentDoing(note=f"agent limits: {words}"))
    activity = None if order.silence_s is None else Activity(order.silence_s, workspace)
    stage = Stage(
        workspace=workspace,
        urls=order.urls,
        environment=environment,
        log=agent_log,
        on_turn=lambda turn, text: emit(messages.AgentTurn(turn=turn, text=text[:_TEXT_SHOWN])),
        session_file=folder.session,
        on_doing=_tell,
        clock=clock,
        activity=activity,
        prompts=msgspec.convert(order.prompts, Prompts),
        tells_left=order.tells_left,
        joins=resources.joins,
    )
    play = asyncio.create_task(_play(order, stage, config, resources))
    ends: dict[str, asyncio.Task[None] | asyncio.Task[str]] = {
        "told": asyncio.create_task(_stopped(orders, clock, activity)),
        "wall_limit": asyncio.create_task(clock.run_out()),
        "disk_limit": asyncio.create_task(resources.too_large()),
    }
    telling = asyncio.create_task(_tell_use(clock, resources))
    log.info("agent started", agent=shown)
    try:
        await asyncio.wait([play, *ends.values()], return_when=asyncio.FIRST_COMPLETED)
        reason = None if play.done() else next(name for name, task in ends.items() if task.done())
        detail = ends[reason].result() if reason == "disk_limit" else ""
        stage.over.set()
        await _until_gone(stage.started)
        # Once its programs have ended, a harness returns by itself with its facts (turns, tokens).
        await asyncio.wait([play], timeout=LAST_WORDS_S)
        play.cancel()
        ending = (await asyncio.gather(play, return_exceptions=True))[0]
    finally:
        for task in (*ends.values(), telling):
            task.cancel()
        emit(messages.AgentUsed(used_s=clock.used_s(), resources=resources.used()))
        resources.remove()
        agent_log.close()
    if isinstance(ending, AgentEnded):
        if reason is not None:
            return msgspec.structs.replace(ending, reason=reason, detail=detail)
        if ending.reason != "agent_failed":
            return ending
        why = "; ".join(filter(None, (ending.detail, resources.reached())))
        # By now the log's redaction knows more than at the start.
        lines = [agent_log.redact(line.encode()).decode("utf-8", "replace") for line in agent_log.last_errors]
        tail = tuple(filter(None, lines))[-_LINES_SHOWN:]
        return msgspec.structs.replace(ending, detail=why, stderr_tail=tail)
    if isinstance(ending, EvopolicyError) or reason is not None:
        return AgentEnded(reason=reason or "agent_failed", detail=detail or str(ending))
    raise ending


async def _play(
    order: StartAgent, stage: Stage, config: AgentConfig | None, resources: Resources
) -> AgentEnded:
    harness = make(order.agent, Path(order.started_in), config)
    urls, harness.relay = order.urls, order.relay
    if order.relay is not None:
        urls = {**urls, "model": order.relay.url}
    passed = [name for name in harness.variables if is_secret(name)]
    if order.jail is not None:
        passed += order.jail.settings.environment
        kept = inputs.KeptInputs()
        if config is not None and order.inputs:
            folder, started_in = Path(order.jail.private) / "inputs", Path(order.started_in)
            kept = await asyncio.to_thread(
                inputs.keep, config.skills, config.mcp, started_in, folder, order.inputs
            )
        harness.take_inputs(kept)
        stage.log.redact = stage.log.redact.knowing(own_config.secrets(harness.own_files))
        await asyncio.to_thread(own_config.copy, harness.own_files, Path(order.jail.private))
        jail = Jail(
            order.jail,
            inputs=kept.shown(harness.skills_at),
            more_programs=[(server.command,) for server in kept.servers.values()],
            # With the relay it needs neither the provider's hosts nor the variables with the key.
            harness="" if order.relay else harness.name,
            command=harness.command,
            variables=harness.variables,
            hosts=harness.hosts,
            packages=harness.packages,
            workspace=stage.workspace,
            urls=urls,
            started_in=Path(order.started_in),
            pids=resources.own_pids,
            fixed_cores=resources.fixed_cores,
        )
        inside = jail.environment(stage.environment, {**order.urls, **order.variables})
        stage = msgspec.structs.replace(stage, environment=inside, jail=jail)
    written = [value for value in stage.log.redact.secrets if value in order.agent]
    copied = own_config.secrets(harness.own_files) if order.jail is not None else ()
    kept_secret = [*written, *copied, *(stage.environment.get(name, "") for name in passed)]
    await asyncio.to_thread(note_passed, RunFolder(Path(order.folder)).passed, kept_secret)
    return await harness.run_agent(stage)


def secrets_in(environment: Mapping[str, str], config: AgentConfig | None) -> dict[str, str]:
    """Variables whose values may be secrets, those that the agent's settings pass on included."""
    named = {} if config is None else {f"{name}_KEY": environment.get(name, "") for name in config.secret}
    return {**environment, **named}


def _tell(doing: messages.AgentDoing) -> None:
    emit(msgspec.structs.replace(doing, action=doing.action[:_TEXT_SHOWN], note=doing.note[:_TEXT_SHOWN]))


async def _tell_use(clock: AgentClock, resources: Resources) -> None:
    """Reports used time and resources, which count for a resumed agent too, and reached limits."""
    told = ""
    while True:
        emit(messages.AgentUsed(used_s=clock.used_s(), resources=resources.used()))
        if not told and (told := resources.reached()):
            emit(messages.AgentDoing(note=told))
        await asyncio.sleep(_TELL_TIME_S)


async def _stopped(orders: Orders, clock: AgentClock, activity: Activity | None) -> None:
    """Returns when the parent requests the stop or is gone; until then forwards its reports to the clocks."""
    while (order := await orders.next()) is not None:
        if isinstance(order, messages.SubmitsSeen):
            clock.set_held(order.held_s)
            if activity is not None:
                activity.note(order.asked, order.running)
        if isinstance(order, messages.StopAgent):
            return


async def _until_gone(started: Collection[int]) -> None:
    """Ends all processes of the agent, and returns when none is alive.

    Processes that survive SIGKILL (stuck in the kernel) are reported to the parent: while they live, the agent is not
    gone.
    """
    reported: list[int] = []
    while survivors := await asyncio.to_thread(processes.end_descendants, END_GRACE_S, waited=started):
        if survivors != reported:
            log.error("processes of the agent survive", pids=survivors)
            emit(messages.AgentSurvives(pids=tuple(survivors)))
            reported = survivors
        await asyncio.sleep(_SURVIVORS_PAUSE_S)


async def _main() -> int:
    setup_logging()
    processes.become_subreaper()
    processes.leave_session_keyring()
    orders = Orders()
    loop = asyncio.get_running_loop()
    first = await orders.next()
    if not isinstance(first, StartAgent):
        return 2
    # Held by this process alone until its death, after an earlier holder: no program of the agent inherits it.
    lock = RunFolder(Path(first.folder)).supervisor_lock
    file = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    await asyncio.to_thread(fcntl.flock, file, fcntl.LOCK_EX)
    main = asyncio.create_task(keep(first, orders))
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, orders.end)
    ended = await main
    log.info("agent ended", reason=ended.reason, detail=ended.detail, turns=ended.turns or None)
    emit(ended)
    return 0


if __name__ == "__main__":
    # os._exit: a thread still reading stdin must not delay the exit.
    try:
        code = asyncio.run(_main())
    except Exception:
        log.exception("the agent supervisor failed")
        code = 1
    sys.stdout.flush()
    os._exit(code)
