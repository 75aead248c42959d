"""The environment's process of a slot: `python -m evopolicy_worker.episodes.env_process`, started by `slot.Slot`.

It owns seeds, rewards, and trajectories, imports its simulators but nothing of Zenoh, and ends with its parent. It
starts inside a jail (`sandbox.env_jail`), starts the policies' sandbox there, and seals itself before it imports a
simulator, since later code may be third-party code. Commands arrive on standard input, and replies go to the original
standard output; output of simulators goes to standard error. The main thread plays, while the monitor's thread receives
commands.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import queue
import resource
import sys
import threading
import time
from pathlib import Path

from evopolicy_common.errors import (
    BrokenEnvironmentError,
    EvopolicyError,
    SandboxError,
    SlotDiedError,
)
from evopolicy_worker import environments
from evopolicy_worker.environments.interface import calls
from evopolicy_worker.episodes.loop import JobPlayer, fault_of
from evopolicy_worker.episodes.monitor import Monitor
from evopolicy_worker.episodes.policies import CancelledJobError, RunningJob
from evopolicy_worker.sandbox import env_jail, jail
from evopolicy_worker.sandbox.zygote import Zygote
from evopolicy_worker.slot_protocol import slot_messages as messages

_PROGRESS_S = 0.25
MOST_JOINED_BYTES = 1 << 20
"""Larger frames are sent by themselves: joined with the next one, they would take their memory again."""
ALIVE_S = 5.0
"""Interval of the messages that this process is alive, seconds, also during a long step."""


class Channel:
    """Commands in, replies out."""

    def __init__(self, commands: int, replies: int) -> None:
        self._commands = commands
        self._replies = replies
        self._received = bytearray()
        self._lock = threading.Lock()

    def receive(self) -> list[messages.Command]:
        """The commands that arrived; blocks until there are bytes. Ends this process when the slot is gone."""
        data = os.read(self._commands, 1 << 20)
        if not data:
            os._exit(0)
        self._received += data
        return [messages.commands.decode(each) for each in messages.unframed(self._received)]

    def send(self, message: messages.SlotMessage) -> None:
        self.send_frame(messages.framed(message))

    def send_frame(self, frame: bytes) -> None:
        data = memoryview(frame)
        with self._lock:
            while data:
                data = data[os.write(self._replies, data) :]


class EnvProcess:
    """One slot's life: start, then job after job."""

    def __init__(self, channel: Channel, commands: int, limits: calls.EnvironmentLimits) -> None:
        self._channel = channel
        self._jobs = queue.SimpleQueue[tuple[messages.Play, RunningJob] | messages.Describe]()
        self._bundle: messages.BundleFiles | None = None
        self._progress: RunningJob | None = None
        self._last_report = (0.0, 0)
        self._limits = limits
        self._guard = calls.LimitGuard(limits)
        self._monitor = Monitor(commands, self._take_commands, self._check_and_report)

    def run(self, start: messages.SlotStart, early: list[messages.Command]) -> None:
        if start.core is not None:
            with contextlib.suppress(OSError):
                os.sched_setaffinity(0, {start.core})
        scratch = Path(start.scratch)
        # Without its parents: a worker that has gone meanwhile has taken them with it.
        scratch.mkdir(exist_ok=True)
        environments.define(start.definitions)
        env_jail.enclose(start.tier, scratch, draws=start.draws)
        plan = jail.plan(start.tier, scratch, start.allowed_packages, sealed=start.sealed, user=start.user)
        with env_jail.expendable():
            zygote = Zygote(plan, scratch)
        env_jail.seal(start.tier, scratch, plan.user, draws=start.draws)
        # In addition to the monitor, for memory allocated between two of its checks; programs often reserve this much
        # more than they use.
        most = 2 * start.limits.memory_bytes
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
        faulthandler.enable(all_threads=False)  # so that a crash names the environment's lines
        calls.current.process = os.getpid()
        player = JobPlayer(zygote, plan, self._monitor, scratch)
        self._take_commands(early)
        self._monitor.start()
        player.policies.prepare()
        self._channel.send(messages.SlotReady())
        while True:
            work = self._jobs.get()
            if isinstance(work, messages.Describe):
                self._channel.send(self._described(player, work.environments))
                continue
            self._channel.send_frame(self._play(player, *work))
            # A sandbox that has ended meanwhile is the next job's to find.
            with contextlib.suppress(SandboxError, SlotDiedError):
                player.policies.prepare()

    def _play(self, player: JobPlayer, command: messages.Play, progress: RunningJob) -> bytes:
        """Plays a job and returns its last frames, which wake the supervisor only once."""
        try:
            self._bundle = command.bundle or self._bundle
            options = (progress, self._channel.send_frame, command.first, command.failure)
            last = player.play_job(command.job, self._bundle, *options)
            progress.give_up(None)
            if len(last) > MOST_JOINED_BYTES:
                self._channel.send_frame(last)
                last = b""
            return last + messages.framed(messages.Played())
        except BaseException as error:  # such as an environment's sys.exit
            progress.give_up(self._channel.send)
            # A cancelled job may meet any other error on its way out.
            cancelled = progress.cancelled or isinstance(error, CancelledJobError)
            return messages.framed(messages.Played(cancelled=True) if cancelled else self._fault(error))
        finally:
            self._progress = None
            self._monitor.ticking = False

    def _described(self, player: JobPlayer, env_ids: tuple[str, ...]) -> messages.Reply:
        self._monitor.ticking = True
        self._monitor.wake()
        try:
            return messages.Described(environments=tuple(player.describe(env_id) for env_id in env_ids))
        except BaseException as error:
            return self._fault(error)
        finally:
            self._monitor.ticking = False

    def _fault(self, error: BaseException) -> messages.Fault:
        text = calls.raised(error, fault_of(error), self._limits)
        calls.current.what = ""
        kind = "sandbox" if isinstance(error, SandboxError | SlotDiedError) else "worker"
        if text or isinstance(error, BrokenEnvironmentError):
            kind = "environment"
        return messages.Fault(kind=kind, message=text or fault_of(error))

    def _take_commands(self, commands: list[messages.Command] | None = None) -> None:
        """Takes these commands, or those that arrive."""
        for command in self._channel.receive() if commands is None else commands:
            if isinstance(command, messages.Describe):
                self._jobs.put(command)
            elif isinstance(command, messages.Play):
                # From now on it can be cancelled, also before it is taken up.
                self._last_report = 0.0, 0
                self._progress = RunningJob()
                # This is the monitor's own thread, which need not be woken for it.
                self._monitor.ticking = True
                self._jobs.put((command, self._progress))
            elif isinstance(command, messages.Cancel) and (progress := self._progress) is not None:
                progress.cancel()
                # Now: a simulator may take long over its step, and is ended then.
                progress.give_up(self._channel.send)

    def _check_and_report(self) -> None:
        now = time.monotonic()
        progress = self._progress
        if passed := self._guard.check(now):
            if progress is not None:
                progress.give_up(self._channel.send)
            self._channel.send(messages.Fault(kind="environment", message=passed))
            os._exit(1)
        if progress is None:
            return
        at, steps = self._last_report
        if now - at >= (_PROGRESS_S if progress.steps != steps else ALIVE_S):
            self._last_report = now, progress.steps
            progress.report(self._channel.send)


def main() -> None:
    commands, replies = messages.take_pipes()
    channel = Channel(commands, replies)
    while not (received := channel.receive()):
        pass
    start, *early = received
    if not isinstance(start, messages.SlotStart):
        sys.exit(f"the first command is {type(start).__name__}, not Start")
    try:
        EnvProcess(channel, commands, start.limits).run(start, early)
    except EvopolicyError as error:
        kind = "sandbox" if isinstance(error, SandboxError) else "worker"
        channel.send(messages.Fault(kind=kind, message=str(error)))


if __name__ == "__main__":
    main()
