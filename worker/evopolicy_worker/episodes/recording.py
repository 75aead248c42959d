"""The slot's client of its video process: sends it episodes and receives MP4 bytes.

Rules:
- A video is optional. Where an environment cannot be rendered here, or the renderer crashes or times out, the episode
  keeps its outcome without a video, and a note on standard error gives the reason.
- The process renders one environment only, since a second one with MuJoCo's renderer has crashed processes.
- It is the slot's child: pinned to the same core, and ended with the slot.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable

import msgspec

from evopolicy_common.errors import WorkerError
from evopolicy_common.messages.environment import Case, EnvironmentDescription
from evopolicy_worker import environments
from evopolicy_worker.environments.interface.calls import note
from evopolicy_worker.episodes.video import Made, Order
from evopolicy_worker.slot_protocol.slot_messages import LENGTH

START_S = 120.0
"""Time for the process to start and import its simulator."""
FRAME_S = 1.0
"""Time for each frame. The slowest take about 0.06 s."""
MAX_S = 1800.0
"""Maximum time for one video; below the hour of grace that a lease has beyond its episode's limits."""
MAX_FAILURES = 3
"""Number of consecutive failures after which this slot makes no more videos of an environment."""
_POLL_S = 0.1
_PIECE = 1 << 20


class VideoRecorder:
    """Makes videos of played episodes. Not thread-safe."""

    def __init__(self, start_s: float = START_S, frame_s: float = FRAME_S) -> None:
        """Timeouts for the start and for each frame, in seconds."""
        self._start_s = start_s
        self._frame_s = frame_s
        self._process: subprocess.Popen[bytes] | None = None
        self._env = ""
        self._failures: Counter[str] = Counter()
        self._noted: set[str] = set()

    def record(
        self,
        description: EnvironmentDescription,
        case: Case,
        actions: bytes,
        length: int,
        cancelled: Callable[[], bool],
    ) -> bytes | None:
        """MP4 bytes of an episode of `length` rows; None when it cannot be made, or once `cancelled()` is true.

        `actions`: the episode's trajectory with record "actions".
        """
        env = description.env
        if not description.renders:
            self._note(f"no video: {env} does not render")
            return None
        if self._failures[env] >= MAX_FAILURES:
            return None
        allowed_s = min(MAX_S, self._start_s + self._frame_s * length)
        order = msgspec.msgpack.encode(Order(case=case, actions=actions))
        try:
            made = self._ask(env, LENGTH.pack(len(order)) + order, time.monotonic() + allowed_s, cancelled)
        except (OSError, WorkerError) as error:
            made = Made(mp4=None, error=str(error))
        if made is None:
            self.close()
            return None
        if made.mp4 is None:
            self.close()
            self._failures[env] += 1
            self._note(f"no video of an episode of {env}: {made.error}")
            if self._failures[env] == MAX_FAILURES:
                self._note(f"{env}: {MAX_FAILURES} videos in a row failed; this slot makes no more of it")
            return None
        self._failures[env] = 0
        return made.mp4

    def close(self) -> None:
        """Ends the process; the next `record` starts it again. A second close does nothing."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None
                pipe.close()

    def _ask(self, env: str, order: bytes, deadline: float, cancelled: Callable[[], bool]) -> Made | None:
        """The process's answer; None when cancelled. Raises OSError, or WorkerError when the process ends or times
        out."""
        process = self._running(env)
        assert process.stdin is not None
        assert process.stdout is not None
        orders, replies = process.stdin.fileno(), process.stdout.fileno()
        unsent, answer = memoryview(order), bytearray()
        while not (len(answer) >= LENGTH.size and len(answer) >= LENGTH.size + LENGTH.unpack_from(answer)[0]):
            if cancelled():
                return None
            if time.monotonic() > deadline:
                raise WorkerError("it took too long")
            readable, writable, _ = select.select([replies], [orders] if unsent else [], [], _POLL_S)
            if writable:
                unsent = unsent[os.write(orders, unsent[:_PIECE]) :]
            if readable:
                piece = os.read(replies, _PIECE)
                if not piece:
                    raise WorkerError(f"the process that draws it ended with status {process.wait()}")
                answer += piece
        return msgspec.msgpack.decode(memoryview(answer)[LENGTH.size :], type=Made)

    def _running(self, env: str) -> subprocess.Popen[bytes]:
        if self._process is not None and self._env != env:
            self.close()
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "evopolicy_worker.episodes.video", env, *environments.definition(env)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                env={**os.environ, **environments.process_environment(render=True)},
            )
            self._env = env
            assert self._process.stdin is not None
            os.set_blocking(self._process.stdin.fileno(), False)
        return self._process

    def _note(self, text: str) -> None:
        """Prints each note once per slot."""
        if text not in self._noted:
            self._noted.add(text)
            note(text)
