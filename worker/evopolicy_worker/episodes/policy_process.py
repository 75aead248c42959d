"""One policy in the sandbox, as the episode loop uses it: init, reset, act, and its failure.

Rules:
- Every behaviour of the policy is either a reply or a `PolicyFailedError`. A fault of the sandbox, or an end from
  outside (`endings`), is a SandboxError and never attributed to the policy.
- A policy that died or violated the pipes' protocol is `dead`; a policy whose code raised continues to run.
- After an episode is played, no end of its policy invalidates it.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import sys
import threading
import time
from typing import Any, NamedTuple

from evopolicy_common.errors import SandboxError, SlotDiedError
from evopolicy_common.messages.episode import FailureCategory, PolicyFailure, ResourceLimits
from evopolicy_common.processes import proc
from evopolicy_common.processes.packages import SIMULATORS
from evopolicy_worker.episodes import frames
from evopolicy_worker.episodes.monitor import STOPPED_S, ExceededLimit, Monitor, Watch
from evopolicy_worker.sandbox import zygote as zygotes
from evopolicy_worker.sandbox.inside import policy_server
from evopolicy_worker.sandbox.jail import PolicyJail
from evopolicy_worker.sandbox.zygote import Exit, ForkedPolicy, Zygote, wait_dead
from evopolicy_worker.slot_protocol import endings
from evopolicy_worker.slot_protocol import slot_messages as messages
from evopolicy_worker.slot_protocol.endings import EndedFromOutsideError, Ending

_OURS = ("common", "worker", "coordinator", "results", "gateway")
_DENIED = frozenset((*SIMULATORS, *(f"evopolicy_{name}" for name in _OURS), "zenoh"))
"""Modules that a policy may not import: simulators and our own code, which it does not see."""
_GRACE_S = 1.0
_SEAL_S = 60.0
"""Time limit for our own work before the bundle is imported."""
_EXIT_S = 5.0
"""Longest wait for a process that is ending."""
_LARGE_SHARE = 0.125
"""Share of its memory limit above which a policy that ended silently, while the system ran out of memory, counts as
ended for its own memory use."""
_ROUND_BYTES = 1 << 20
_SHIM_BROKEN = 70
"""Exit status of a policy's process in which `inside/zygote.py` goes on after the policy."""
_ARRAY_HEAD_BYTES = 8 + 4 * 64
"""Before an array's own bytes: its type and its shape, which numpy lets have 64 axes."""
_USUAL_ACTION_BYTES = 256
"""Size of an action, beyond 16 bytes for each number of the action space, that does not count against the limit of
its episode."""
_MAX_MESSAGE = 2000
_MAX_TRACEBACK = 16_000
_LIMITS: dict[str, tuple[FailureCategory, str, str]] = {
    "memory": ("oom", "memory_bytes", "memory: {:,} bytes besides Python's own are the limit"),
    "files": ("file_limit", "file_bytes", "files: {:,} bytes written are the limit"),
    "inodes": ("file_limit", "files", "files: {:,} files and folders are the limit"),
    "descriptors": ("file_limit", "open_files", "files: {} open descriptors are the limit"),
    "processes": (
        "process_limit",
        "processes",
        "processes: {} threads are the limit, whose stacks count as memory, and no process may be started",
    ),
}
"""By the kind of limit that a policy's process reports: the failure's category, the limit, and a text."""
_STAGES: dict[str, FailureCategory] = {
    "import": "import_error",
    "init": "init_error",
    "reset": "reset_error",
    "act": "act_error",
}


def address_space(base_bytes: int, memory_bytes: int) -> int:
    """The limit of a policy's address space, bytes, which the policy can read.

    `base_bytes`: its size with Python alone. It differs by a page between the zygotes of a machine, depending on where
    the kernel put the heap, so that a policy could tell slots apart; rounded up to 1 MiB, it does not.
    """
    return -(-base_bytes // _ROUND_BYTES) * _ROUND_BYTES + memory_bytes


class PolicyFailedError(Exception):
    """The policy failed; `failure` says how (its step is for the episode loop to add)."""

    def __init__(self, failure: PolicyFailure) -> None:
        super().__init__(failure.message)
        self.failure = failure


class PolicyEnd(NamedTuple):
    """A policy's output and processor time, seconds, when it or its episode ends."""

    stdout: bytes
    stderr: bytes
    cpu_s: float


class PolicyProcess:
    """A forked process of the zygote's that becomes one Policy."""

    def __init__(
        self,
        zygote: Zygote,
        child: ForkedPolicy,
        monitor: Monitor,
        jail: PolicyJail,
        limits: ResourceLimits,
        folder: str,
        oom_kills: int | None = None,
    ) -> None:
        """`folder` is where its files are when the jail gives it no home of its own; `oom_kills`, what that function
        gave before."""
        self._zygote = zygote
        self._child = child
        self._monitor = monitor
        self._limits = limits
        self._home = jail.home or folder
        self._enclosed = jail.home is not None
        # A CPU limit of the worker's own is the policy's too, and ends it by SIGKILL.
        self._held = bool(jail.config["seals"]) and resource.getrlimit(resource.RLIMIT_CPU) == (-1, -1)
        self._watch = Watch(child, limits, count_threads=not self._enclosed, held=self._held)
        # If they cannot be read, those of Python with numpy.
        self._base_bytes, self._base_resident = proc.sizes(child.host_pid) or (1 << 29, 1 << 25)
        self._oom_kills = oom_kills
        self._write: frames.Writer
        self._action_bytes = 0
        self._usual_bytes = 0
        self._surplus_bytes = 0
        self._exit: Exit | None = None
        self._gone = False
        self._finished: PolicyEnd | None = None
        self._closing = threading.Lock()
        self._requests = child.requests
        self._replies = child.replies
        self.dead = False

    def compiled(self, source: bytes, env_meta: dict[str, Any]) -> bytes:
        """The code of a `policy.py`, for the `load` of other processes; nothing where they are to compile it
        themselves.

        Only Python's compiler reads it here: this process runs none of it.
        """
        self.seal(
            messages.BundleFiles([("policy.py", False, len(source))], source), bytes(16), env_meta, "arrays"
        )
        try:
            return self._request(policy_server.COMPILE, "init", self._limits.init_wall_s)
        except PolicyFailedError:
            # The process that plays finds and reports it again.
            return b""

    def load(self, code: bytes) -> None:
        """Imports the bundle, with the code of its `policy.py` if that is known, and builds its Policy.

        Raises PolicyFailedError with a category of NO_POLICY.
        """
        self._watch.spent_s = 0.0
        self._request(policy_server.LOAD, "init", self._limits.init_wall_s, 0, code)

    def seal(
        self,
        bundle: messages.BundleFiles,
        seed: bytes,
        env_meta: dict[str, Any],
        observations: str,
        spaces: tuple[Any, Any] | None = None,
    ) -> None:
        """Gives the process its bundle and its limits, and takes its rights away. `spaces`: of observations and actions
        where `env_meta` describes them in another form."""
        limits = self._limits
        obs_space, action_space = spaces or (env_meta["obs_space"], env_meta["action_space"])
        needed = 16 * frames.elements(action_space)
        self._action_bytes = limits.action_bytes + needed
        self._usual_bytes = _USUAL_ACTION_BYTES + needed
        n_folders = len({name.rpartition("/")[0] for name, _, _ in bundle.names}) * 16
        rlimits = {
            "RLIMIT_AS": address_space(self._base_bytes, limits.memory_bytes),
            "RLIMIT_FSIZE": limits.file_bytes,
            "RLIMIT_NOFILE": limits.open_files,
            "RLIMIT_CORE": 0,
            "RLIMIT_MEMLOCK": 0,
            "RLIMIT_MSGQUEUE": 0,
            "RLIMIT_SIGPENDING": 256,
        }
        if self._enclosed:
            # Counted per user namespace: its parent and the zygote are in it too.
            rlimits["RLIMIT_NPROC"] = limits.processes + 2
        init = {
            "home": self._home,
            "home_bytes": limits.file_bytes + sum(-(-size // 4096) * 4096 for _, _, size in bundle.names),
            "home_inodes": limits.files + len(bundle.names) + n_folders,
            "files": bundle.names,
            "limits": rlimits,
            "seed": seed.hex(),
            "observed": obs_space,
            "obs_space": env_meta["obs_space"],
            "action_space": env_meta["action_space"],
            "env_meta": env_meta,
            "observations": observations,
            "action_bytes": self._action_bytes,
        }
        self._write = frames.compile_writer(obs_space)
        self._monitor.watch(self._watch)
        head = json.dumps(init).encode()
        self._request(policy_server.INIT, "seal", _SEAL_S, len(head), head, bundle.data)

    def begin_episode(self) -> None:
        """Wall, CPU time and output count from here; the first episode's include the import."""
        self._watch.begin_episode()

    def reset(self, episode_index: int) -> None:
        """Raises PolicyFailedError."""
        self._surplus_bytes = 0
        self._request(policy_server.RESET, "reset", self._limits.act_wall_s, episode_index)
        # Here for all steps of the episode, which have the same limit.
        self._watch.what = "act"

    def act(self, obs: Any) -> Any:
        """The policy's answer to one observation, as it returned it. Raises PolicyFailedError."""
        tag, payload = self._exchange(*self._write(obs))
        if tag <= policy_server.GENERIC:
            if len(payload) > self._action_bytes + _ARRAY_HEAD_BYTES:
                how = f"it sent an action of {len(payload):,} bytes; {self._action_bytes:,} are the limit"
                raise self._broken(how, self._action_bytes, len(payload))
            if len(payload) > self._usual_bytes:
                # Actions are kept as they came, so an episode's bytes beyond the usual size have a limit.
                self._surplus_bytes += len(payload) - self._usual_bytes
                limit, used = self._limits.episode_action_bytes, self._surplus_bytes
                if used > limit:
                    text = (
                        f"actions larger than the action space needs came to {used:,} bytes in this episode;"
                    )
                    raise self._failed("act_error", f"{text} {limit:,} are the limit", "", limit, used)
            try:
                return frames.action(tag, payload, self._action_bytes // policy_server.VALUE_BYTES)
            except frames.BadReplyError as error:
                raise self._broken(str(error)) from None
        raise self._reported_failure(tag, payload, "act")

    def take_output(self) -> PolicyEnd:
        """Output and CPU time of the episode that ends; the policy lives on when it can.

        EndedFromOutsideError when it was ended so: the policy of the episodes to come is lost.
        """
        if not self.dead:
            with contextlib.suppress(PolicyFailedError):
                self._request(policy_server.FLUSH, "act", _GRACE_S)
        if self.dead:
            return self.end()
        ended = self._output(self._watch.cpu_s() - self._watch.cpu_start_s)
        self._monitor.watch(self._watch)
        return ended

    def _output(self, cpu_s: float) -> PolicyEnd:
        # From here on no other thread reads it.
        self._monitor.watch(None)
        self._watch.drain()
        return PolicyEnd(self._watch.stdout.take_output(), self._watch.stderr.take_output(), cpu_s)

    def end(self) -> PolicyEnd:
        """End the process, if it has not ended, and collect what it leaves."""
        if self._finished is None:
            if not self.dead:
                with contextlib.suppress(PolicyFailedError, EndedFromOutsideError):
                    self._request(policy_server.END, "act", _GRACE_S)
            alive_s = max(0.0, self._watch.cpu_s() - self._watch.cpu_start_s)
            self._finished = self._output(self._cpu_of_episode() if self.dead else alive_s)
            with self._closing:
                if self._gone:
                    self._child.close()
                else:
                    # Its last reply has arrived; later output of a hostile policy is not read.
                    self._zygote.bury_later(self._child)
        return self._finished

    def kill(self) -> None:
        """SIGKILL from any thread; the loop finds out by itself."""
        with self._closing:
            if self._finished is None:
                self._child.kill()

    # Requests and replies.

    def _request(self, kind: int, stage: str, limit_s: float, argument: int = 0, *payload: bytes) -> bytes:
        """The answer to a request that succeeds. Raises PolicyFailedError."""
        self._watch.what, self._watch.answer_limit_s = stage, limit_s
        length = sum(map(len, payload))
        header = policy_server.REQUEST_HEADER.pack(length, kind, argument)
        tag, answer = self._exchange([header, *payload], 16 + length)
        if tag != policy_server.OK:
            raise self._reported_failure(tag, answer, stage)
        return answer

    def _exchange(self, parts: list[Any], total: int) -> tuple[int, bytes]:
        watch = self._watch
        start = watch.since = time.monotonic()
        try:
            # The system takes 1,024 pieces at once; only odd spaces have more leaves.
            n = os.writev(self._requests, parts[:1024])
            if n < total:
                self._write_rest(parts, n)
            data = os.read(self._replies, 65536)
        except BrokenPipeError:
            data = b""
        if len(data) < 8:
            data = self._read_more(data, 8)
        length, tag = policy_server.REPLY_HEADER.unpack_from(data)
        if len(data) != 8 + length:
            if length > frames.MAX_REPLY_BYTES:
                how = f"it announced an answer of {length:,} bytes; {frames.MAX_REPLY_BYTES:,} are the limit"
                raise self._broken(how, frames.MAX_REPLY_BYTES, length)
            data = self._read_more(data, 8 + length)
            if len(data) > 8 + length:
                raise self._broken("it sent more than one answer to one question")
        watch.since = 0.0
        watch.spent_s += time.monotonic() - start
        return tag, data[8:]

    def _write_rest(self, parts: list[Any], n: int) -> None:
        pieces = [part if type(part) is bytes else part.tobytes() for part in parts]
        unsent = memoryview(b"".join(pieces))[n:]
        while unsent:
            unsent = unsent[os.write(self._requests, unsent) :]

    def _read_more(self, data: bytes, wanted: int) -> bytes:
        pieces = [data]
        have = len(data)
        while have < wanted:
            piece = os.read(self._replies, min(1 << 20, wanted - have))
            if not piece:
                raise self._died()
            pieces.append(piece)
            have += len(piece)
        return b"".join(pieces)

    # How it failed.

    def _reported_failure(self, tag: int, payload: bytes, asked: str) -> PolicyFailedError:
        if asked == "seal":
            # None of the bundle's code has run: this is ours.
            self._bury()
            raise SandboxError(
                f"a policy's process could not seal itself: {payload.decode('utf-8', 'replace')}"
            )
        if tag != policy_server.FAILED:
            return self._broken(f"it answered {asked} with frame {tag}")
        try:
            report = frames.report(payload)
        except frames.BadReplyError as error:
            return self._broken(str(error))
        stage = report.stage if asked == "init" and report.stage in ("import", "init") else asked
        category = _STAGES[stage]
        limit, used = None, None
        message = report.message
        if report.kind in _LIMITS:
            of_kind, name, text = _LIMITS[report.kind]
            limit = used = getattr(self._limits, name)
            if report.kind == "memory":
                peak = proc.number(f"/proc/{self._child.host_pid}/status", "VmPeak")
                used = None if peak is None else max(0.0, float(peak * 1024 - self._base_bytes))
            if stage in ("reset", "act"):
                category = of_kind
            message = f"{message} [{text.format(limit)}]"
        elif report.kind == "action":
            limit, used = self._action_bytes, report.used
        if stage == "import" and report.missing:
            top = report.missing.partition(".")[0]
            if top in _DENIED:
                category = "denied_import"
                message = f"{message}: policies may not import {top}; they see observations only"
        return self._failed(category, message, report.traceback, limit, used)

    def _broken(self, how: str, limit: float | None = None, used: float | None = None) -> PolicyFailedError:
        """The failure of a process that broke the rules of its pipes, which is ended."""
        self._bury()
        text = f"the policy's process was ended: {how}"
        return self._failed(self._fatal("killed"), text, "", limit, used)

    def _died(self) -> PolicyFailedError:
        """Its pipe closed: the policy's failure, by the table of endings. EndedFromOutsideError when it is none."""
        watch, limits = self._watch, self._limits
        alive = not wait_dead(self._child.pidfd, 0.05)
        if alive and ((stat := proc.stat(self._child.host_pid)) is None or stat.exiting):
            alive = not wait_dead(self._child.pidfd, _EXIT_S)
        self._bury()
        exit_, verdict = self._exit, watch.verdict
        if verdict is None and exit_ is not None and not alive and not watch.stopped:
            verdict = self._limit_of(exit_)
        if verdict is not None:
            ending, text = Ending("policy", "SIGKILL", verdict.category), verdict.message
        elif watch.stopped:
            ending, text = Ending("policy", "stop"), f"the policy's process was stopped for {STOPPED_S:g} s"
        elif alive:
            ending, text = Ending("policy", "pipe"), "the policy closed the pipe that it answers on"
        elif exit_ is None:
            ending, text = Ending("sandbox", "SIGKILL"), "the policy's sandbox ended"
        else:
            ending = Ending("policy", endings.how(exit_.status))
            text = f"the policy's process {exit_.describe()}"
            if os.WIFEXITED(exit_.status) and os.WEXITSTATUS(exit_.status) == _SHIM_BROKEN:
                text += ", as it does when the code in it that answers for the policy was broken"
            if os.WIFSIGNALED(exit_.status) and os.WTERMSIG(exit_.status) == signal.SIGBUS:
                text += f", as for writing to a mapped file when its files have {limits.file_bytes:,} bytes, the limit"
        category = endings.verdict(ending._replace(began=watch.what != "seal", held=self._held))
        if category is None:
            if watch.what == "seal":
                raise EndedFromOutsideError(f"a policy's process could not seal itself: {text}")
            raise EndedFromOutsideError(f"{text}, and neither the policy nor a limit can have done that")
        _, _, limit, used = verdict or (None, None, None, None)
        return self._failed(self._fatal(category), text, "", limit, used)

    def _limit_of(self, exit_: Exit) -> ExceededLimit | None:
        """The limit for which the system ended it."""
        limits, cpu_s = self._limits, self._cpu_of_episode()
        if not os.WIFSIGNALED(exit_.status):
            return None
        if cpu_s > limits.cpu_s:
            text = f"the policy used more than {limits.cpu_s:g} s of CPU time"
            return ExceededLimit("cpu_limit", text, limits.cpu_s, cpu_s)
        held = exit_.peak_bytes - self._base_resident
        large = endings.how(exit_.status) == "SIGKILL" and held > _LARGE_SHARE * limits.memory_bytes
        if large and ((counted := oom_kills()) is None or counted != self._oom_kills):
            text = (
                f"the system ended the policy for want of memory: it held {held:,} bytes besides Python's own;"
                f" {limits.memory_bytes:,} are the limit"
            )
            return ExceededLimit("oom", text, limits.memory_bytes, held)
        return None

    def _fatal(self, category: FailureCategory) -> FailureCategory:
        """Before the Policy exists, every end of the process means that the bundle yields none."""
        return "init_error" if self._watch.what == "init" else category

    def _bury(self) -> None:
        """The process is dead when this returns, or was killed and is reaped later; `_exit` states how it ended."""
        self.dead = True
        self._watch.since = 0.0
        self._child.kill()
        self._gone = wait_dead(self._child.pidfd, zygotes.DEATH_TIMEOUT_S)
        if self._gone:
            # None when the sandbox has ended.
            with contextlib.suppress(SlotDiedError):
                self._exit = self._zygote.wait(self._child)

    def _cpu_of_episode(self) -> float:
        """CPU time that the dead process used since the episode began, seconds; 0.0 if unknown."""
        return max(0.0, self._exit.cpu_s - self._watch.cpu_start_s) if self._exit is not None else 0.0

    def _failed(
        self,
        category: FailureCategory,
        message: str,
        traceback: str,
        limit: float | None,
        used: float | None,
    ) -> PolicyFailedError:
        self._watch.since = 0.0
        failure = PolicyFailure(
            category=category,
            step_index=None,
            message=self._without_paths(message)[:_MAX_MESSAGE],
            traceback=self._without_paths(traceback)[-_MAX_TRACEBACK:],
            limit=limit,
            used=used,
        )
        return PolicyFailedError(failure)

    def _without_paths(self, text: str) -> str:
        """Text without this machine's folders: `system/policy.py`, `python3.11/random.py`, `numpy/…`."""
        text = text.encode("utf-8", "replace").decode().replace(f"{self._home}/", "")
        library = f"python{sys.version_info.major}.{sys.version_info.minor}"
        for prefix in (os.path.realpath(sys.base_prefix), sys.base_prefix):
            text = text.replace(f"{prefix}/lib/{library}/", f"{library}/")
        return text.replace("/packages/", "")


def oom_kills() -> int | None:
    """How many processes this machine has ended so far for want of memory; None when it does not tell."""
    return proc.number("/proc/vmstat", "oom_kill")
