"""The environment process's second thread: drains a policy's output, enforces its limits, and receives the
supervisor's commands.

Rules:
- The episode loop never waits for this thread, and a step costs nothing for it.
- A thread that uses a policy's output descriptors holds the lock.
- A policy that exceeds a limit is ended by SIGKILL; the loop then finds its pipe closed, and the verdict here.
- Wall time in which the policy could not run counts against no limit: it was stopped from outside, it waited for a core
  that its own threads did not use, or this process itself was stopped.
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import NamedTuple

from evopolicy_common.messages.episode import FailureCategory, ResourceLimits
from evopolicy_common.processes import proc
from evopolicy_worker.sandbox.zygote import ForkedPolicy

TICK_S = 0.1
"""How often limits are checked while a policy works, seconds; sooner when one is near."""
_SHORTEST_TICK_S = 0.005
_SLOW_S = 0.05
"""How long a policy owes an answer before the monitor checks whether it runs."""
LATE_S = 0.5
"""A check that comes so much later than planned means that this process was not let run, seconds."""
STOPPED_S = 10.0
"""Seconds after which a policy that was stopped from outside is ended and restarted."""
STOPPED = ("T", "t")
"""States of a process that is stopped, or held by a debugger."""
_PIECE = 65536


class ExceededLimit(NamedTuple):
    """The limit that a policy was ended for."""

    category: FailureCategory
    message: str
    limit: float
    used: float


class Output:
    """Keeps the first `limit` bytes of a stream; reads and drops all others."""

    def __init__(self, fd: int, limit: int) -> None:
        os.set_blocking(fd, False)
        self.fd = fd
        self._limit = limit
        self._kept = bytearray()
        self.open = True
        """False once the policy has closed the stream."""

    def drain(self) -> None:
        """Reads available output without waiting."""
        with contextlib.suppress(BlockingIOError):
            for _ in range(64):
                if not self.open:
                    break
                data = os.read(self.fd, _PIECE)
                self.open = bool(data)
                self._kept += data[: self._limit - len(self._kept)]

    def take_output(self) -> bytes:
        """Returns the stored output and clears it."""
        kept, self._kept = bytes(self._kept), bytearray()
        return kept


class Watch:
    """The watched values of one policy process. The episode loop writes the times, the monitor reads them."""

    def __init__(
        self, child: ForkedPolicy, limits: ResourceLimits, *, count_threads: bool, held: bool = False
    ) -> None:
        """`held`: whether only others can stop it."""
        self.child = child
        self.limits = limits
        self.stdout = Output(child.stdout, limits.output_bytes)
        self.stderr = Output(child.stderr, limits.output_bytes)
        self.since = 0.0
        """Since when (monotonic) the policy owes an answer; 0.0 while it owes none."""
        self.what = ""
        """The current request: `import`, `init`, `reset`, `act`."""
        self.answer_limit_s = limits.init_wall_s
        self.spent_s = 0.0
        """Its earlier wall time in this episode."""
        self.cpu_start_s = 0.0
        self.verdict: ExceededLimit | None = None
        self.stopped = False
        """Whether it was ended because it stood stopped."""
        self._held = held
        self._checked = self._next = time.monotonic()
        # Excused seconds: in the episode; in the answer that was owed at the last check, and its start; separately, the
        # waits for a processor, which the kernel counts.
        self._excused_s = self._in_episode_s = 0.0
        self._answer = self._answer_excused_s = self._in_answer_s = 0.0
        self._episode_waited = 0.0
        self._answer_waited: float | None = None
        # How long it has been stopped, and waiting, up to the last check.
        self._stood_s = self._waiting_s = self._cpu_s = 0.0
        self._cpu_clock = proc.clock(child.host_pid) if child.host_pid else 0
        self._count_threads = count_threads

    def begin_episode(self) -> None:
        """Wall and CPU time count from here."""
        self.spent_s = self._excused_s = self._in_episode_s = 0.0
        self.cpu_start_s = self.cpu_s()
        self._episode_waited = self._waited_s(self.cpu_start_s)

    def cpu_s(self) -> float:
        """CPU time of the process so far, seconds; 0.0 when it is gone."""
        try:
            return time.clock_gettime(self._cpu_clock) if self._cpu_clock else 0.0
        except OSError:
            return 0.0

    def drain(self) -> None:
        """Reads the policy's output, so that it never waits for us."""
        self.stdout.drain()
        self.stderr.drain()

    def judge(self, now: float) -> float:
        """Ends the policy if it passed a limit; seconds until it is worth checking again."""
        self._excuse(now)
        pause_s = self._judge(now)
        self._next = now + pause_s
        return pause_s

    def _judge(self, now: float) -> float:
        since = self.since
        if not since or self.verdict is not None:
            return TICK_S
        if self._stood_s > STOPPED_S and self.since == since:
            self.stopped = True
            self.child.kill()
            return TICK_S
        limits = self.limits
        running, in_episode = self._used(since, now)
        if running >= self.answer_limit_s or in_episode >= limits.episode_wall_s:
            # The last answers may have waited, too, while nothing was checked.
            self._count_waits(self.cpu_s())
            running, in_episode = self._used(since, now)
        remaining_answer_s = self.answer_limit_s - running
        remaining_episode_s = limits.episode_wall_s - in_episode
        cpu = self.cpu_s() - self.cpu_start_s
        verdict: ExceededLimit | None = None
        if remaining_answer_s <= 0:
            text, most = f"{self.what} took longer than {self.answer_limit_s:g} s", self.answer_limit_s
            verdict = ExceededLimit("act_timeout", text, most, running)
        elif remaining_episode_s <= 0:
            text = f"the policy worked for longer than {limits.episode_wall_s:g} s in this episode"
            verdict = ExceededLimit("episode_timeout", text, limits.episode_wall_s, in_episode)
        elif cpu > limits.cpu_s:
            text = f"the policy used more than {limits.cpu_s:g} s of CPU time in this episode"
            verdict = ExceededLimit("cpu_limit", text, limits.cpu_s, cpu)
        elif self._count_threads:
            n = proc.number(f"/proc/{self.child.host_pid}/status", "Threads") or 0
            if n > limits.processes:
                text = f"the policy had {n} threads; {limits.processes} are the limit"
                verdict = ExceededLimit("process_limit", text, limits.processes, n)
        if verdict is not None and self.since == since:
            self.verdict = verdict
            self.child.kill()
        return max(_SHORTEST_TICK_S, min(TICK_S, remaining_answer_s, remaining_episode_s))

    def _excuse(self, now: float) -> None:
        """Count the time from the last check on in which the policy was not let run."""
        since, last, self._checked = self.since, self._checked, now
        if self._answer != since:
            self._answer, self._answer_waited = since, None
            self._answer_excused_s = self._stood_s = self._waiting_s = self._in_answer_s = 0.0
        owed_s = now - max(since, last) if since else 0.0
        if now - self._next > LATE_S:
            # The episode loop stood still, too, whether or not it has its answer by now.
            self._excused_s += now - last
            self._answer_excused_s += owed_s
        elif owed_s and now - since > _SLOW_S:
            cpu_s, stat = self.cpu_s(), proc.stat(self.child.host_pid)
            state = "" if stat is None else stat.state
            if self._held and state in STOPPED:
                self._stood_s += owed_s
                self._excused_s += owed_s
                self._answer_excused_s += owed_s
            else:
                self._stood_s = 0.0
            # The kernel counts a wait when it is over.
            self._waiting_s = self._waiting_s + owed_s if state == "R" and cpu_s == self._cpu_s else 0.0
            self._cpu_s = cpu_s
            self._count_waits(cpu_s)

    def _count_waits(self, cpu_s: float) -> None:
        waited = self._waited_s(cpu_s)
        self._answer_waited = waited if self._answer_waited is None else self._answer_waited
        self._in_episode_s = max(0.0, waited - self._episode_waited)
        self._in_answer_s = max(0.0, waited - self._answer_waited)

    def _used(self, since: float, now: float) -> tuple[float, float]:
        """Wall time of the pending reply and of the episode, without excused time, seconds."""
        owed_s = now - since - self._waiting_s
        in_answer = owed_s - self._answer_excused_s - self._in_answer_s
        return in_answer, self.spent_s + owed_s - self._excused_s - self._in_episode_s

    def _waited_s(self, cpu_s: float) -> float:
        """How long the process's first thread has waited so far for a processor that its other threads did not have,
        seconds.

        0.0 where the kernel does not tell.
        """
        pid = self.child.host_pid
        try:
            with open(f"/proc/{pid}/task/{pid}/schedstat") as file:
                ran, waited = file.read().split()[:2]
            return int(waited) / 1e9 - (cpu_s - int(ran) / 1e9)
        except (OSError, ValueError):
            return 0.0


class Monitor(threading.Thread):
    """Watches one policy at a time, and one descriptor for commands."""

    def __init__(self, commands: int, on_command: Callable[[], None], on_tick: Callable[[], None]) -> None:
        """`on_command` reads from `commands` when there is something; `on_tick` runs every tick while one is
        watched."""
        super().__init__(name="monitor", daemon=True)
        self._commands = commands
        self._on_command = on_command
        self._on_tick = on_tick
        self._lock = threading.Lock()
        self._watch: Watch | None = None
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.ticking = False
        """Whether to tick although no policy is watched: while random actions are played."""

    def watch(self, watch: Watch | None) -> None:
        """Watch this policy from now on; None to stop. After the return no other thread touches the one before."""
        with self._lock:
            self._watch = watch
        self.wake()

    def wake(self) -> None:
        """Look at once: something has changed."""
        os.eventfd_write(self._wake, 1)

    def run(self) -> None:
        """The thread: checks the watched policy and receives commands until the process ends. If it fails itself, it
        ends the process: a policy without a monitor has no limits, and a slot without commands hangs."""
        try:
            self._watch_on()
        except BaseException:
            traceback.print_exc()
            sys.stderr.flush()
            os._exit(1)

    def _watch_on(self) -> None:
        pause_s = 0.0
        while True:
            with self._lock:
                watch = self._watch
            poller = select.poll()
            poller.register(self._commands, select.POLLIN)
            poller.register(self._wake, select.POLLIN)
            busy = watch is not None or self.ticking
            for output in (watch.stdout, watch.stderr) if watch is not None else ():
                if output.open:
                    poller.register(output.fd, select.POLLIN)
            ready = {fd for fd, _ in poller.poll(pause_s * 1000 if busy else None)}
            if self._wake in ready:
                os.eventfd_read(self._wake)
            if self._commands in ready:
                self._on_command()
            pause_s = TICK_S
            with self._lock:
                if watch is not None and self._watch is watch:
                    watch.drain()
                    pause_s = watch.judge(time.monotonic())
            if busy:
                self._on_tick()


def is_stopped(pid: int) -> bool:
    """Whether the process is stopped, or held by a debugger."""
    stat = proc.stat(pid)
    return stat is not None and stat.state in STOPPED
