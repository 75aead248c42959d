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
    WorkerError,
)
from evopolicy_worker import environments
from evopolicy_worker.environments.interface import calls
from evopolicy_worker.episodes.loop import Player, fault_of
from evopolicy_worker.episodes.monitor import Monitor
from evopolicy_worker.episodes.policy_process import BundleFiles
from evopolicy_worker.episodes.progress import CancelledJobError, Progress
from evopolicy_worker.sandbox import env_jail, jail
from evopolicy_worker.sandbox.zygote import Zygote
from evopolicy_worker.slot_protocol import slot_messages as messages
from evopolicy_worker.slot_protocol.child_pipes import take_pipes

_PROGRESS_S = 0.25
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
        found: list[messages.Command] = []
        size = messages.LENGTH.size
        while len(self._received) >= size:
            (length,) = messages.LENGTH.unpack_from(self._received)
            if len(self._received) < size + length:
                break
            found.append(messages.commands.decode(bytes(self._received[size : size + length])))
            del self._received[: size + length]
        return found

    def send(self, message: messages.Message) -> None:
        self.send_frame(messages.framed(message))

    def send_frame(self, frame: bytes) -> None:
        data = memoryview(frame)
        with self._lock:
            while data:
                data = data[os.write(self._replies, data) :]


class EnvProcess:
    """One slot's life: start, then job after job."""

    def __init__(self, channel: Channel, commands: int) -> None:
        self._channel = channel
        self._jobs: queue.SimpleQueue[tuple[messages.Play, Progress] | messages.Describe] = (
            queue.SimpleQueue()
        )
        self._bundle: tuple[str, BundleFiles] | None = None
        self._progress: Progress | None = None
        self._last_report = (0.0, 0)
        self._limits = calls.Limits()
        self._guard = calls.Guard(self._limits)
        self._monitor = Monitor(commands, self._hear, self._tell)

    def run(self, start: messages.Start, early: list[messages.Command]) -> None:
        if start.core is not None:
            with contextlib.suppress(OSError):
                os.sched_setaffinity(0, {start.core})
        scratch = Path(start.scratch)
        # Without its parents: a worker that has gone meanwhile has taken them with it.
        scratch.mkdir(exist_ok=True)
        environments.define(start.definitions)
        self._limits = start.limits
        self._guard = calls.Guard(start.limits)
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
        player = Player(zygote, plan, self._monitor, scratch)
        for command in early:
            self._take(command)
        self._monitor.start()
        player.prepare()
        self._channel.send(messages.Ready())
        while True:
            work = self._jobs.get()
            if isinstance(work, messages.Describe):
                self._channel.send(self._described(player, work.environments))
                continue
            self._channel.send_frame(self._play(player, *work))
            # A sandbox that has ended meanwhile is the next job's to find.
            with contextlib.suppress(SandboxError, SlotDiedError):
                player.prepare()

    def _play(self, player: Player, command: messages.Play, progress: Progress) -> bytes:
        """Plays a job and returns its last frames, which wake the supervisor only once."""
        try:
            files = self._files(command.bundle)
            last = player.play(
                command.job, files, progress, self._channel.send_frame, command.first, command.failure
            )
            progress.give_up(None)
            return last + messages.framed(messages.Played())
        except CancelledJobError:
            progress.give_up(self._channel.send)
            return messages.framed(messages.Played(cancelled=True))
        except BaseException as error:  # such as an environment's sys.exit
            progress.give_up(self._channel.send)
            # With a cancellation: whatever it met on its way out.
            answer = messages.Played(cancelled=True) if progress.cancelled else self._fault(error)
            return messages.framed(answer)
        finally:
            self._progress = None
            self._monitor.ticking = False

    def _described(self, player: Player, env_ids: tuple[str, ...]) -> messages.Reply:
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
        if text or isinstance(error, BrokenEnvironmentError):
            return messages.Fault(kind="environment", message=text or fault_of(error))
        kind = "sandbox" if isinstance(error, SandboxError | SlotDiedError) else "worker"
        return messages.Fault(kind=kind, message=fault_of(error))

    def _files(self, bundle: messages.Files | None) -> BundleFiles | None:
        if bundle is None:
            return None
        if bundle.names is not None:
            self._bundle = bundle.key, BundleFiles(bundle.names, bundle.data)
        if self._bundle is None or self._bundle[0] != bundle.key:
            raise WorkerError("a job came without its bundle's files")
        return self._bundle[1]

    def _hear(self) -> None:
        for command in self._channel.receive():
            self._take(command)

    def _take(self, command: messages.Command) -> None:
        if isinstance(command, messages.Describe):
            self._jobs.put(command)
        elif isinstance(command, messages.Play):
            # From now on it can be cancelled, also before it is taken up.
            self._last_report = 0.0, 0
            self._progress = Progress()
            # This is the monitor's own thread, which need not be woken for it.
            self._monitor.ticking = True
            self._jobs.put((command, self._progress))
        elif isinstance(command, messages.Cancel):
            progress = self._progress
            if progress is not None:
                progress.cancel()
                # Now: a simulator may take long over its step, and is ended then.
                progress.give_up(self._channel.send)

    def _tell(self) -> None:
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
            self._channel.send(messages.Progress(episodes_done=progress.episodes_done, steps=progress.steps))


def main() -> None:
    """The process's entry."""
    commands, replies = take_pipes()
    channel = Channel(commands, replies)
    received: list[messages.Command] = []
    while not received:
        received = channel.receive()
    start, *early = received
    if not isinstance(start, messages.Start):
        sys.exit(f"the first command is {type(start).__name__}, not Start")
    try:
        EnvProcess(channel, commands).run(start, early)
    except EvopolicyError as error:
        kind = "sandbox" if isinstance(error, SandboxError) else "worker"
        channel.send(messages.Fault(kind=kind, message=str(error)))


if __name__ == "__main__":
    main()
