"""The slot's end of its video process: hands it episodes, gets MP4 bytes back, and does without it when it must.

Rules: a video is an extra. Where an environment does not draw here, the renderer crashes or takes too long, the
episode keeps its outcome, there is no video, and a note on standard error says why. The process draws one environment
only (a second one with MuJoCo's renderer has crashed processes) and is the slot's child: pinned to its core, ended with it.
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
from evopolicy_worker.episodes.video import Made, Order
from evopolicy_worker.slots.slot_messages import LENGTH, NOTE

START_S = 120.0
"""For the process to start and import its simulator."""
FRAME_S = 1.0
"""For each frame; the slowest take some 0.06 s."""
MAX_S = 1800.0
"""For one video; below the hour of grace that a lease has beyond its episode's limits."""
MAX_FAILURES = 3
"""After so many failures in a row an environment's videos are given up in this slot."""
_LOOK_S = 0.1
_PIECE = 1 << 20


class VideoRecorder:
    """Records videos of episodes that were played. Not thread-safe."""

    def __init__(self, start_s: float = START_S, frame_s: float = FRAME_S) -> None:
        """Time allowed for a start and for each frame, seconds."""
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
        """MP4 bytes of an episode of `length` rows; None where there can be none, or once `cancelled` says so.

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
        """End the process; it is started again when it is needed. A second close does nothing."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None
                pipe.close()

    def _ask(self, env: str, order: bytes, deadline: float, cancelled: Callable[[], bool]) -> Made | None:
        """The answer; None when it was cancelled. Raises OSError, or WorkerError for a process that gives none."""
        process = self._running(env)
        assert process.stdin is not None
        assert process.stdout is not None
        orders, answers = process.stdin.fileno(), process.stdout.fileno()
        unsent, answer = memoryview(order), bytearray()
        while not (len(answer) >= LENGTH.size and len(answer) >= LENGTH.size + LENGTH.unpack_from(answer)[0]):
            if cancelled():
                return None
            if time.monotonic() > deadline:
                raise WorkerError("it took too long")
            readable, writable, _ = select.select([answers], [orders] if unsent else [], [], _LOOK_S)
            if writable:
                unsent = unsent[os.write(orders, unsent[:_PIECE]) :]
            if readable:
                piece = os.read(answers, _PIECE)
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
        """Said once a slot."""
        if text not in self._noted:
            self._noted.add(text)
            print(f"{NOTE}{text}", file=sys.stderr, flush=True)
