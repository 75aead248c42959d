"""An episode's video: the slot's `VideoRecorder`, and the process that it starts,
`python -m evopolicy_worker.episodes.video ENV_ID`.

Rules:
- The episode is replayed from its actions in a rendering environment of that process. The original episode
  never renders: its bytes are the same with and without a video, and no policy is charged for rendering.
- Frame t shows the state in which row t's action was chosen, that of the row's observation. There are as many frames as
  rows, and the state after the last step has none.
- A replay that differs from the episode in any reward or flag yields no video, since it would show another episode.
- A video is optional. Where an environment cannot be rendered here, or the renderer crashes or times out, the episode
  keeps its outcome without a video, and a note on standard error gives the reason.
- The process renders one environment only, since a second one with MuJoCo's renderer has crashed processes.
  It is the slot's child: pinned to the same core, and ended with the slot.
- One episode at a time: a framed `VideoOrder` on standard input, a framed `MadeVideo` on the original standard output.
  Output of simulators and drivers goes to standard error.
"""

from __future__ import annotations

import io
import os
import select
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import BinaryIO

import msgspec
import numpy as np

from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import WorkerError
from evopolicy_common.installation import add_extra
from evopolicy_common.messages.environment import Case, EnvironmentDescription
from evopolicy_common.records.episodes.trajectory import decode
from evopolicy_worker import environments
from evopolicy_worker.environments import Environment, Frame
from evopolicy_worker.environments.interface.calls import note
from evopolicy_worker.slot_protocol.slot_messages import LENGTH, framed, take_pipes, unframed

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
CRF = 28
"""x264's constant rate factor: 200 frames of 600 × 400 come to some 66 KiB."""
PRESET = "veryfast"
MIN_RATE, MAX_RATE = 4, 30
"""Frames a second."""
EPISODE_S = 10
"""Target duration of the video of a full-length episode, seconds, if the frame rates allow it."""


class VideoOrder(msgspec.Struct, frozen=True, kw_only=True):
    """The episode to record."""

    case: Case
    actions: bytes
    """`trajectory` codec bytes with record "actions": the repaired actions and their results."""


class MadeVideo(msgspec.Struct, frozen=True, kw_only=True):
    mp4: bytes | None
    error: str = ""
    """Why there is no video."""


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
        deadline = time.monotonic() + min(MAX_S, self._start_s + self._frame_s * length)
        try:
            made = self._ask(env, framed(VideoOrder(case=case, actions=actions)), deadline, cancelled)
        except (OSError, WorkerError) as error:
            made = MadeVideo(mp4=None, error=str(error))
        if made is not None and made.mp4 is not None:
            self._failures[env] = 0
            return made.mp4
        self.close()
        if made is not None:
            self._failures[env] += 1
            self._note(f"no video of an episode of {env}: {made.error}")
            if self._failures[env] == MAX_FAILURES:
                self._note(f"{env}: {MAX_FAILURES} videos in a row failed; this slot makes no more of it")
        return None

    def close(self) -> None:
        """Ends the process; the next `record` starts it again. A second close does nothing."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None
                pipe.close()

    def _ask(
        self, env: str, order: bytes, deadline: float, cancelled: Callable[[], bool]
    ) -> MadeVideo | None:
        """The process's answer; None when cancelled. Raises OSError, or WorkerError when the process ends or times
        out."""
        if self._env != env:
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
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        orders, replies = process.stdin.fileno(), process.stdout.fileno()
        os.set_blocking(orders, False)
        unsent, received = memoryview(order), bytearray()
        while not (answers := unframed(received)):
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
                received += piece
        return msgspec.msgpack.decode(answers[0], type=MadeVideo)

    def _note(self, text: str) -> None:
        """Prints each note once per slot."""
        if text not in self._noted:
            self._noted.add(text)
            note(text)


# The rest runs in the process.


def encoded(frames: Iterable[Frame], rate: int) -> bytes:
    """An MP4 of frames of one size: H.264 in 4:2:0, encoded in this process and in memory, by one thread for the same
    bytes. `rate`: frames a second. An odd side gains a line, as 4:2:0 needs: its last one again.

    WorkerError where PyAV is not installed, or frames are of several sizes.
    """
    try:
        import av
    except ImportError as error:
        raise WorkerError(
            f"videos are encoded with PyAV, which is not installed ({error}): {add_extra('worker')}"
        ) from error
    file = io.BytesIO()
    container = av.open(file, "w", format="mp4")
    stream = container.add_stream("libx264", rate=rate, options={"preset": PRESET, "crf": str(CRF)})
    stream.pix_fmt = "yuv420p"
    stream.codec_context.thread_count = 1
    shape: tuple[int, ...] | None = None
    for frame in frames:
        height, width = frame.shape[:2]
        if shape is None:
            shape = frame.shape
            stream.height, stream.width = height + height % 2, width + width % 2
        if frame.shape != shape:
            raise WorkerError(f"a frame of shape {frame.shape} follows frames of shape {shape}")
        if height % 2 or width % 2:
            frame = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
    container.mux(stream.encode(None))
    container.close()
    return file.getvalue()


def replay(environment: Environment, case: Case, actions: bytes) -> Iterator[Frame]:
    """The frames of the episode in `actions`, one a row.

    `environment` was made with `render=True`. WorkerError where it does not draw, or plays another episode.
    """
    environment.reset(case)
    for row in decode(actions).rows():
        yield environment.render()
        # Repaired already, and once more for its type: the codec's arrays may come back as other views.
        step = environment.step(environment.action_codec.repair(row.action)[0])
        # A run's own limit of steps truncates an episode that the environment would continue.
        if (step.reward, step.terminated) != (row.reward, row.terminated) or step.truncated > row.truncated:
            raise WorkerError(
                f"{environment.description.env} departs from the recorded episode at step {row.t}"
            )


def serve(env_id: str, orders: BinaryIO, replies: BinaryIO) -> None:
    """Record one episode after another until there are no more orders."""
    environment: Environment | None = None
    while head := orders.read(LENGTH.size):
        order = msgspec.msgpack.decode(orders.read(LENGTH.unpack(head)[0]), type=VideoOrder)
        try:
            if environment is None:
                environment = environments.make(env_id, render=True)
            # By the environment alone, so that its videos run side by side.
            rate = environment.description.max_episode_steps // EPISODE_S
            rate = max(MIN_RATE, min(MAX_RATE, rate))
            made = MadeVideo(mp4=encoded(replay(environment, order.case, order.actions), rate))
        except Exception as error:
            # Drivers and simulators raise any exception here, and a missing picture is no failure of the episode.
            why = str(error) if isinstance(error, WorkerError) else f"{type(error).__name__}: {error}"
            made = MadeVideo(mp4=None, error=why)
        replies.write(framed(made))
        replies.flush()


def main() -> None:
    orders, replies = take_pipes()
    with os.fdopen(orders, "rb") as reader, os.fdopen(replies, "wb") as writer:
        env_id, *definitions = sys.argv[1:]
        environments.define(msgspec.json.decode(each, type=Entry) for each in definitions)
        serve(env_id, reader, writer)
        # Not by way of exit handlers, of which a graphics driver's may hang or crash.
        os._exit(0)


if __name__ == "__main__":
    main()
