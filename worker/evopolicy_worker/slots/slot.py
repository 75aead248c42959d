"""A slot: plays one job at a time on one core. The supervisor's handle of an environment process and its sandbox.

Rules:
- A job's failure is its policy's (an outcome) or an infrastructure failure (WorkerError, SandboxError, SlotDiedError:
  the job is played elsewhere), as the table in `endings` decides.
- A crash on a policy's actions is its failure: random actions play that episode, and the policy the rest of the job.
- If the process ends otherwise, the actions that the policy had returned are read from the scratch folder.

| state | event | next |
|---|---|---|
| closed | `start` | ready; closed, with SandboxError or WorkerError |
| ready | `play_job` | playing; in a new process if this one may remember a hidden episode, or cannot draw |
| | `describe` | ready; its process has ended or is killed, with BrokenEnvironmentError or SlotDiedError |
| playing | `JobProgress`, `Acting`, `Finished`, `Begun`, `Filmed` | playing |
| | `Played` | ready, with the outcomes; without any after `cancel` |
| | `Fault` | ready, with its error |
| | the environment ends, breaks down or hangs on a policy's actions | playing, in a new process |
| | the process ends otherwise | ended, with SlotDiedError or BrokenEnvironmentError |
| | `cancel`, and no answer for `CANCEL_TIMEOUT_S` | ended |
| | the task of `play_job` is cancelled | ended |
| ended | `start` | as from closed |
| any | `close` | closed; its scratch folder is removed |
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections import deque
from collections.abc import Callable, Collection, Sequence
from functools import cache
from pathlib import Path

import msgspec

from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import (
    DECODE_ERRORS,
    BrokenEnvironmentError,
    EvopolicyError,
    SandboxError,
    SlotDiedError,
    WorkerError,
)
from evopolicy_common.logs import structlog
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import EpisodeOutcome, Job, PolicyFailure, Tier
from evopolicy_common.processes import proc
from evopolicy_common.processes.child_process import ignore_broken_stdin
from evopolicy_common.processes.scratch import remove_tree, scratch_folder
from evopolicy_worker.environments.interface.calls import NOTE, USUAL, EnvironmentLimits, hung, last_words
from evopolicy_worker.environments.registry import remembers
from evopolicy_worker.episodes.monitor import is_stopped
from evopolicy_worker.sandbox import env_jail, jail
from evopolicy_worker.slot_protocol import begun, endings
from evopolicy_worker.slot_protocol import slot_messages as messages
from evopolicy_worker.slot_protocol.begun import HandedBack, PackedBegun
from evopolicy_worker.slot_protocol.endings import Ending, How

log: structlog.stdlib.BoundLogger = structlog.get_logger()

START_TIMEOUT_S = 120.0
CANCEL_TIMEOUT_S = 20.0
"""A cancelled job that has not stopped after this time has its processes killed."""
LAST_WORDS_S = 5.0
"""How long to wait for an ended process's status, and for its jail to be gone."""
STOPPED_S = 30.0
"""Processes that have been stopped from outside for this long are killed, and their job is played elsewhere."""
SILENT_S = 60.0
"""Processes that say nothing for so much longer than a call of an environment may take are killed: the call holds the
interpreter."""
DESCRIBED_CALLS = 3
"""A description may take as long as this number of calls."""
_CHECK_S = 5.0
MAX_ANSWER_BYTES = 1 << 31
_PIECE = 1 << 20


class Slot:
    """An environment process in its own jail, with the policies that it plays in a sandbox inside. Used by one asyncio
    loop."""

    def __init__(
        self,
        core: int | None,
        tier: Tier,
        scratch: Path,
        allowed_packages: tuple[str, ...] = ("numpy",),
        *,
        sealed: bool = True,
        definitions: tuple[Entry, ...] = (),
        limits: EnvironmentLimits = USUAL,
    ) -> None:
        """`core`: the CPU that all processes are pinned to; None for no pinning. `scratch`: a folder for this slot
        alone. `definitions`: environments that do not ship. `limits`: those of an environment.

        `sealed=False` (tests only) leaves the policy's process unsealed.
        """
        self._start = messages.SlotStart(
            tier=tier,
            core=core,
            scratch=str(scratch),
            allowed_packages=allowed_packages,
            user=jail.some_user() if tier == "bwrap" and os.geteuid() == 0 else None,
            sealed=sealed,
            definitions=definitions,
            limits=limits,
        )
        self._saw_hidden = False
        """Whether an environment that may remember has played a hidden episode in the current process."""
        self._scratch = scratch
        self._cancelled = False
        self._sent: Path | None = None
        """The folder of the bundle that the process has."""
        self._kept = ""
        """The last job, if its policy's actions remain valid."""
        self._begun: dict[int, PackedBegun] = {}
        self._outcomes: list[EpisodeOutcome] = []
        self._acting = False
        """Whether an action of the policy's has reached the environment in the running episode."""
        self._n_replies = 0
        self._hung = ""
        """Why the processes were killed while they played."""
        self._process: asyncio.subprocess.Process | None = None
        self._stderr: deque[str] = deque(maxlen=40)
        self._listener: asyncio.Task[None] | None = None
        self._idle = asyncio.Event()
        self._idle.set()

    async def start(self) -> None:
        """Starts the processes, after ending any earlier ones.

        Raises SandboxError, with a remedy, when this machine cannot provide the tier, and WorkerError for other
        failures.
        """
        await self.close()
        self._scratch.mkdir(parents=True, exist_ok=True)
        self._sent = None
        self._saw_hidden = False
        for name in ("home", "tmp"):  # must not pass files from the previous process to this one
            remove_tree(self._scratch / name)
        start, pipe = self._start, asyncio.subprocess.PIPE
        command = env_jail.command(
            start.tier, self._scratch, draws=start.draws, definitions=start.definitions
        )
        own, limit = env_jail.variables(self._scratch), 1 << 20
        made = asyncio.create_subprocess_exec(
            *command, stdin=pipe, stdout=pipe, stderr=pipe, limit=limit, env=own, start_new_session=True
        )
        starting = asyncio.ensure_future(made)
        try:
            self._process = await asyncio.shield(starting)
        except asyncio.CancelledError:
            # Of bubblewrap asyncio would kill the first process alone, and the second would wait for it forever.
            _kill(await starting)
            raise
        ignore_broken_stdin(self._process)
        self._stderr.clear()
        self._listener = asyncio.create_task(self._listen(self._process))
        try:
            async with asyncio.timeout(START_TIMEOUT_S):
                await self._send(start)
                reply = await self._reply()
            failed = None if isinstance(reply, messages.SlotReady) else _error(reply)
        except TimeoutError:
            failed = WorkerError(f"a slot did not start within {START_TIMEOUT_S:g} s")
        except SlotDiedError as error:
            # Bubblewrap says why it cannot make a sandbox.
            failed = (SandboxError if "bwrap: " in str(error) else WorkerError)(str(error))
        if failed is not None:
            await self.close()
            raise failed

    async def prepare(self, env_ids: Sequence[str]) -> None:
        """Starts the processes if necessary and makes these environments, so that later jobs find them ready. Raises as
        `start` and `describe`."""
        if self._process is None:
            await self.start()
        if env_ids:
            await self.describe(env_ids)

    async def play_job(
        self, job: Job, bundle: Path | None, on_progress: Callable[[int, int], None]
    ) -> tuple[EpisodeOutcome, ...]:
        """Plays a job and returns an outcome for each of its episodes, in order, with trajectories inline.

        `bundle`: the unpacked bundle's folder; None for random actions. `on_progress` receives the numbers of finished
        episodes and steps. A cancelled job returns an empty tuple. After a cancellation or an error, `begun` has what
        the policy had returned. Raises SlotDiedError, SandboxError or WorkerError.
        """
        self._begun = begun.unpack(job)
        self._kept = job.job_id if begun.is_kept(job) else ""
        self._hung, self._cancelled, self._outcomes = "", False, []
        if self._process is None:
            raise WorkerError("the slot is not started")
        if job.tier != self._start.tier:
            raise WorkerError(f"job {job.job_id} demands tier {job.tier}; this slot has {self._start.tier}")
        self._idle.clear()
        watcher = asyncio.create_task(self._end_hung(job.env))
        failure: PolicyFailure | None = None
        try:
            if job.video and not self._start.draws and env_jail.graphics_devices():
                self._start = msgspec.structs.replace(self._start, draws=True)
                await self.start()
            # No memory that an environment has of a hidden episode must reach the policy of a train episode.
            if self._saw_hidden and job.record == "full":
                await self.start()
            while True:
                files = None
                if bundle is not None and bundle != self._sent:
                    files = await asyncio.to_thread(bundle_files, bundle)
                if self._cancelled:
                    return ()
                self._sent = bundle or self._sent
                play = messages.Play(job=job, bundle=files, first=len(self._outcomes), failure=failure)
                try:
                    return await self._attempt(play, on_progress)
                except (SlotDiedError, BrokenEnvironmentError) as error:
                    failure = self._failed(job, error)
                await self.start()
        except asyncio.CancelledError:
            # The rest of this job's answers will not be read, so the processes cannot be used again.
            _kill(self._process)
            raise
        finally:
            watcher.cancel()
            self._idle.set()

    async def _attempt(
        self, play: messages.Play, on_progress: Callable[[int, int], None]
    ) -> tuple[EpisodeOutcome, ...]:
        """The job's outcomes, once the episodes from `play.first` have been played."""
        outcomes, self._acting = self._outcomes, False
        # Here, as a process that dies of a hidden episode is replaced by one that plays it again.
        self._saw_hidden = self._saw_hidden or (play.job.record != "full" and remembers(play.job.env))
        await self._send(play)
        while True:
            match await self._reply():
                case messages.JobProgress() as reply:
                    on_progress(reply.episodes_done, reply.steps)
                case messages.Acting():
                    self._acting = True
                case messages.Finished() as reply:
                    self._acting = False
                    if reply.begun is not None:
                        self._begun[len(outcomes)] = reply.begun
                    outcomes.append(reply.outcome)
                case messages.Filmed(place=k, video=video):
                    outcomes[k] = msgspec.structs.replace(outcomes[k], video=video)
                case messages.Begun() as reply:
                    self._begun[reply.place] = reply.begun
                case messages.Played() as reply:
                    return () if reply.cancelled else tuple(outcomes)
                case reply:
                    raise _error(reply)

    def _failed(self, job: Job, error: SlotDiedError | BrokenEnvironmentError) -> PolicyFailure:
        """The policy's failure if the environment ended on its actions. Raises if they are not the cause."""
        told = isinstance(error, BrokenEnvironmentError)
        how = "overrun" if told or self._hung else self._how_it_ended()
        again = self._acting and job.environment_faults >= endings.AGAIN
        ours = endings.verdict(Ending("environment", how, began=self._acting, again=again)) is None
        if ours or self._cancelled or job.bundle is None:
            if told:
                raise error
            why = f"environment {job.env}: its process ended while it played; {error}"
            raise self._broken(why) from error
        log.warning("slot died on a policy's actions", job=job.job_id, error=self._hung or str(error))
        self._hung = ""
        if begun.is_kept(job):
            self._begun[len(self._outcomes)] = PackedBegun(failure=endings.BROKE_DOWN)
        return endings.BROKE_DOWN

    @property
    def begun(self) -> HandedBack | None:
        """The policy's actions in the last, unfinished job; None without any."""
        return begun.pack(self._begun | begun.recovered(self._scratch, self._kept))

    async def describe(self, env_ids: Sequence[str]) -> tuple[EnvironmentDescription, ...]:
        """Descriptions of these environments, which are made in the slot's process and stay there for jobs. Raises as
        `play_job`."""
        if self._process is None:
            raise WorkerError("the slot is not started")
        limits = self._start.limits
        descriptions: list[EnvironmentDescription] = []
        for env_id in env_ids:
            try:
                async with asyncio.timeout(DESCRIBED_CALLS * limits.call_s + SILENT_S):
                    await self._send(messages.Describe(environments=(env_id,)))
                    reply = await self._reply()
            except TimeoutError:
                _kill(self._process)
                why = hung(f"environment {env_id}, make, reset or step", limits.call_s)
                raise BrokenEnvironmentError(why) from None
            except SlotDiedError as error:
                why = f"environment {env_id}: its process ended while it was tried out; {error}"
                raise self._broken(why) from error
            if not isinstance(reply, messages.Described):
                raise _error(reply)
            descriptions += reply.environments
        return tuple(descriptions)

    def memory_bytes(self) -> int:
        """Resident memory of all of the slot's processes; each has its part of the memory that several
        share."""
        return 0 if self._process is None else _memory(self._process.pid)

    async def cancel(self) -> None:
        """Stops the running job, if any; its `play_job` returns, and the slot can be used again."""
        if self._idle.is_set():
            return
        process = self._process
        self._cancelled = True
        with contextlib.suppress(SlotDiedError):
            await self._send(messages.Cancel())
        try:
            async with asyncio.timeout(CANCEL_TIMEOUT_S):
                await self._idle.wait()
        except TimeoutError:
            if process is self._process:
                _kill(process)

    async def close(self) -> None:
        """Ends the slot's processes and removes its scratch folder. A second close does nothing."""
        process, self._process = self._process, None
        _kill(process)
        if process is not None:
            await process.wait()
            # Open as long as any process in the jail lives; the kernel kills those after the jail's first process.
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LAST_WORDS_S):
                    while process.stdout is not None and await process.stdout.read(1 << 20):
                        pass
        if self._listener is not None:
            self._listener.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._listener
            self._listener = None
        await asyncio.to_thread(remove_tree, self._scratch)

    async def _send(self, message: messages.SlotMessage) -> None:
        process = self._process
        assert process is not None
        assert process.stdin is not None
        try:
            process.stdin.write(messages.framed(message))
            await process.stdin.drain()
        except (ConnectionError, OSError) as error:
            raise SlotDiedError(await self._last_words()) from error

    async def _reply(self) -> messages.Reply:
        process = self._process
        assert process is not None
        assert process.stdout is not None
        try:
            (length,) = messages.LENGTH.unpack(await process.stdout.readexactly(messages.LENGTH.size))
            if length > MAX_ANSWER_BYTES:
                raise SlotDiedError(f"the slot's process announced an answer of {length} bytes")
            data = bytearray()
            # Recordings have up to a gigabyte: in pieces, as the reader's own buffer would hold each twice.
            while left := length - len(data):
                data += await process.stdout.readexactly(min(left, _PIECE))
            self._n_replies += 1
            return messages.replies.decode(data)
        except DECODE_ERRORS as error:
            raise WorkerError(f"an answer of the slot's process cannot be read: {error}") from error
        except (asyncio.IncompleteReadError, ConnectionError) as error:
            raise SlotDiedError(await self._last_words()) from error

    async def _end_hung(self, env_id: str) -> None:
        """Kills the slot's processes when one of them has been stopped from outside for `STOPPED_S`, or when they say
        nothing although they tell twelve times a minute that they are alive."""
        stood_s = silent_s = 0.0
        n_replies = -1
        longest_s = self._start.limits.call_s + SILENT_S
        while True:
            await asyncio.sleep(_CHECK_S)
            process = self._process
            pids = [] if process is None else [process.pid, *_children(process.pid, self._start.tier)]
            stood_s = stood_s + _CHECK_S if any(map(is_stopped, pids)) else 0.0
            silent_s = silent_s + _CHECK_S if n_replies == self._n_replies and not stood_s else 0.0
            n_replies = self._n_replies
            if silent_s >= longest_s:
                self._hung = hung(f"environment {env_id}, reset or step", self._start.limits.call_s)
                _kill(process)
                silent_s = 0.0
            if stood_s >= STOPPED_S:
                log.warning("slot was stopped from outside", for_s=stood_s)
                _kill(process)

    def _broken(self, text: str) -> WorkerError:
        """The error for a process that ended: by itself or in a call that does not return, or from outside."""
        if self._hung or self._how_it_ended() in ("exit", "fault"):
            return BrokenEnvironmentError(self._hung or text)
        return SlotDiedError(text)

    def _how_it_ended(self) -> How:
        code = None if self._process is None else self._process.returncode
        if code is None:
            return "pipe"
        if self._start.tier == "bwrap" and code > 128:
            code = 128 - code  # bubblewrap reports a signal as 128 + its number
        return endings.how(-code if code < 0 else code << 8)

    async def _last_words(self) -> str:
        status = "?"
        if self._process is not None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LAST_WORDS_S):
                    status = str(await self._process.wait())
        await asyncio.sleep(0)
        words = last_words(self._stderr) or "no stderr output"
        return f"the slot's process ended with status {status}; {words}"

    async def _listen(self, process: asyncio.subprocess.Process) -> None:
        """Keeps the last lines of the process's standard error (simulators' notices, our tracebacks) and logs them."""
        assert process.stderr is not None
        while True:
            try:
                line = await process.stderr.readline()
            except ValueError:  # a line beyond the reader's limit; it is dropped
                continue
            if not line:
                return
            text = line.decode("utf-8", "replace").rstrip()[:500]
            self._stderr.append(text)
            if text.startswith(NOTE):
                log.warning("slot notes", text=text.removeprefix(NOTE))
            else:
                log.debug("slot says", text=text)


def _children(pid: int, tier: Tier) -> list[int]:
    """In tier bwrap, the processes below `pid` (bubblewrap) down to the environment's own. Empty in other tiers, where
    `pid` is the environment's process."""
    pids: list[int] = []
    with contextlib.suppress(OSError, LookupError):
        for _ in range(2 if tier == "bwrap" else 0):
            pid = int(Path(f"/proc/{pid}/task/{pid}/children").read_text().split()[0])
            pids.append(pid)
    return pids


def _memory(pid: int) -> int:
    # Where the kernel does not show it, memory that several share counts for each.
    sizes = (proc.proportional_bytes(each.pid) or proc.sizes(each.pid) for each in proc.family(pid))
    return sum(size if isinstance(size, int) else (size or (0, 0))[1] for size in sizes)


def bundle_files(folder: Path) -> messages.BundleFiles:
    """The unpacked bundle in `folder`. Raises WorkerError when it cannot be read."""
    names: list[tuple[str, bool, int]] = []
    data: list[bytes] = []
    for root, folders, files in os.walk(folder):
        folders.sort()
        for name in sorted(files):
            path = os.path.join(root, name)
            try:
                # An unpacked bundle has no links, so never follow one.
                with open(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), "rb") as file:
                    content = file.read()
                    executable = bool(os.fstat(file.fileno()).st_mode & 0o100)
            except OSError as error:
                raise WorkerError(f"the unpacked bundle cannot be read: {error}") from error
            names.append((os.path.relpath(path, folder), executable, len(content)))
            data.append(content)
    return messages.BundleFiles(names, b"".join(data))


_FAULTS = {"sandbox": SandboxError, "environment": BrokenEnvironmentError}


def _error(reply: messages.Reply) -> EvopolicyError:
    if not isinstance(reply, messages.Fault):
        return WorkerError(f"the slot's process answered {type(reply).__name__} out of turn")
    return _FAULTS.get(reply.kind, WorkerError)(reply.message)


def _kill(process: asyncio.subprocess.Process | None) -> None:
    if process is not None:
        with contextlib.suppress(ProcessLookupError):
            # The whole group: the sandbox dies with its parent, but simulators' helper processes only with
            # the group.
            os.killpg(process.pid, signal.SIGKILL)


SANDBOXED: tuple[Tier, ...] = ("bwrap", "landlock")
"""Tiers that confine policies, strongest first."""


def available_tiers(*, unsandboxed: bool = False, wanted: Collection[str] = SANDBOXED) -> tuple[Tier, ...]:
    """Tiers that this machine offers, strongest first; `none` only with `unsandboxed`.

    `wanted`: the sandboxed tiers to test; each takes about a second. A job names its tier, and nothing falls back to
    another.
    """
    working = [tier for tier in SANDBOXED if tier in wanted and why_not(tier) is None]
    return (*working, "none") if unsandboxed else tuple(working)


@cache
def why_not(tier: Tier) -> str | None:
    """Why this tier does not work here, with a remedy; None when it works.

    Starts an environment process in its jail, with the policies' sandbox inside. Call it on the main thread,
    and not from a coroutine.
    """
    with scratch_folder("tier") as folder:
        # A subfolder, as for a slot: this process holds the lock of `folder` itself.
        scratch = folder / "slot"
        try:
            jail.plan(tier, scratch, ("numpy",))
            asyncio.run(try_out(Slot(None, tier, scratch)))
        except (EvopolicyError, OSError) as error:
            return str(error)
    return None


async def try_out(slot: Slot) -> None:
    """Starts the slot and closes it. Raises as `Slot.start`."""
    try:
        await slot.start()
    finally:
        await slot.close()
