"""The environment process's handle of a zygote: starts it, has it fork policy processes, and gets their exit statuses.

Rules:
- The zygote runs our code and replies at once. If it does not, the slot is dead.
- All data to and from a policy's process passes over its own pipes, never through the zygote, where a later policy's
  process could read it.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import struct
import subprocess
import tempfile
import time
from pathlib import Path

import msgspec

from evopolicy_common.errors import SandboxError, SlotDiedError
from evopolicy_common.processes import proc
from evopolicy_worker.sandbox.jail import START, PolicyJail

START_TIMEOUT_S = 60.0
ANSWER_TIMEOUT_S = 20.0
DEATH_TIMEOUT_S = 10.0
_MAX_MESSAGE = 1 << 16
_REPORT = struct.Struct("8xi12xi100x5q")
"""Code and status from `siginfo_t` (128 bytes); user and system time and peak memory from `struct rusage`."""


class ForkedPolicy(msgspec.Struct):
    """A forked policy process, and our ends of its pipes."""

    host_pid: int
    """Its pid in our namespace; 0 when it is already gone."""
    pidfd: int
    requests: int
    replies: int
    stdout: int
    stderr: int

    def kill(self) -> None:
        """Sends SIGKILL. In a pid namespace of its own, this also kills everything that it may have started."""
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.pidfd, signal.SIGKILL)

    def close(self) -> None:
        for fd in (self.pidfd, self.requests, self.replies, self.stdout, self.stderr):
            os.close(fd)


class Exit(msgspec.Struct, frozen=True, kw_only=True):
    """How a child ended."""

    status: int
    """A waitpid status."""
    cpu_s: float
    peak_bytes: int = 0
    """Peak resident memory."""

    def describe(self) -> str:
        if os.WIFSIGNALED(self.status):
            number = os.WTERMSIG(self.status)
            with contextlib.suppress(ValueError):
                return f"was ended by {signal.Signals(number).name}"
            return f"was ended by signal {number}"
        return f"exited with status {os.waitstatus_to_exitcode(self.status)}"


class Zygote:
    """One running zygote. Not thread-safe."""

    def __init__(self, jail: PolicyJail, scratch: Path) -> None:
        """Starts the zygote and waits until it can fork. Raises SandboxError, with the output of bubblewrap or Python,
        when it cannot."""
        self._dying: list[ForkedPolicy] = []
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.settimeout(START_TIMEOUT_S)
        with tempfile.TemporaryFile(dir=scratch) as output:
            self._process = subprocess.Popen(
                [*jail.command, str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                pass_fds=[theirs.fileno()],
                cwd="/",
                env=START,
            )
            theirs.close()
            self._control = ours
            try:
                ours.send(json.dumps(jail.config).encode())
                self._wait_until_ready(jail)
            except (OSError, SandboxError) as error:
                self.close()
                output.seek(0)
                words = output.read(4000).decode("utf-8", "replace").strip() or "no stderr output"
                raise SandboxError(f"the sandbox does not start: {error}; {words}") from error
        try:
            # Detects a host that cannot make processes here. Also, the first two forks leave traces that later ones
            # could see.
            for _ in range(2):
                self.bury_later(self.spawn())
            self.bury()
        except BaseException:
            self.close()
            raise

    def spawn(self) -> ForkedPolicy:
        """Forks a policy process. Raises SlotDiedError when the zygote is gone, SandboxError when it cannot make a
        process."""
        try:
            reply, fds = self._ask(b"fk")
            if not reply:
                raise ConnectionResetError("the policy's process was not created")
        except OSError as error:
            raise SlotDiedError(f"the sandbox's zygote is gone: {error}") from error
        if len(fds) != 5:
            raise SandboxError(f"cannot create the policy's process: {reply.decode('utf-8', 'replace')}")
        return ForkedPolicy(pid_of(fds[0]), *fds)

    def _ask(self, request: bytes, *fds: int) -> tuple[bytes, list[int]]:
        """The answer to a request with these descriptors, and the descriptors in it. Raises OSError."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with ours:
            ours.settimeout(ANSWER_TIMEOUT_S)
            with theirs:
                socket.send_fds(self._control, [request], [*fds, theirs.fileno()])
            return socket.recv_fds(ours, _MAX_MESSAGE, 5, socket.MSG_CMSG_CLOEXEC)[:2]

    def wait(self, child: ForkedPolicy) -> Exit:
        """Reaps a child that was killed or has ended. Raises SlotDiedError when the zygote does not reply."""
        try:
            report, _ = self._ask(b"w", child.pidfd)
            code, status, user_s, user_us, system_s, system_us, peak = _REPORT.unpack_from(report)
        except (OSError, struct.error) as error:
            why = f"the sandbox did not report how a policy's process ended: {error}"
            raise SlotDiedError(why) from error
        status = status << 8 if code == os.CLD_EXITED else status
        cpu_s = user_s + system_s + (user_us + system_us) / 1e6
        return Exit(status=status, cpu_s=cpu_s, peak_bytes=peak * 1024)

    def bury_later(self, child: ForkedPolicy) -> None:
        """Kills the child now; `bury` reaps it later, because the kernel takes milliseconds to tear a process down."""
        child.kill()
        self._dying.append(child)

    def bury(self) -> None:
        """Waits for and reaps the children of `bury_later`. Raises SandboxError when one does not end."""
        while self._dying:
            child = self._dying[0]
            if not wait_dead(child.pidfd, DEATH_TIMEOUT_S):
                raise SandboxError(f"a policy's process does not end within {DEATH_TIMEOUT_S:g} s of SIGKILL")
            self.wait(child)
            del self._dying[0]
            child.close()

    def close(self) -> None:
        """Ends the zygote, and with it every process in its sandbox."""
        with contextlib.suppress(OSError):
            self._control.send(b"q ")
        self._control.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(0.5)
        self._process.kill()
        self._process.wait()

    def _wait_until_ready(self, jail: PolicyJail) -> None:
        while True:
            data, fds, _, _ = socket.recv_fds(self._control, _MAX_MESSAGE, 4, socket.MSG_CMSG_CLOEXEC)
            answer = json.loads(data) if data else {"error": "it closed its end"}
            if "map" in answer:
                # The namespace's user 65534 is the unprivileged user of that id outside.
                folder = Path(f"/proc/{pid_of(fds[0])}")
                (folder / "setgroups").write_text("deny")
                for name in ("gid_map", "uid_map"):
                    (folder / name).write_text(f"65534 {jail.user} 1\n")
                os.close(fds[0])
                self._control.send(b"mapped")
            elif "ready" in answer:
                return
            else:
                raise SandboxError(str(answer.get("error", answer)))


def pid_of(pidfd: int) -> int:
    """The process's pid in our namespace; 0 when it is gone."""
    return max(0, proc.number(f"/proc/self/fdinfo/{pidfd}", "Pid") or 0)


def wait_dead(pidfd: int, timeout_s: float) -> bool:
    """Waits until the process has ended; False on timeout."""
    poller = select.poll()
    poller.register(pidfd, select.POLLIN)
    end = time.monotonic() + timeout_s
    while (remaining_s := end - time.monotonic()) > 0:
        if poller.poll(remaining_s * 1000):
            return True
    return False
