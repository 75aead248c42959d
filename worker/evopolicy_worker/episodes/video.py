"""An episode's video: `python -m evopolicy_worker.episodes.video ENV_ID`, started by `recording.VideoRecorder`.

Rules:
- The episode is replayed from its actions in a rendering environment of this process. The original episode never
  renders: its bytes are the same with and without a video, and no policy is charged for rendering.
- Frame t shows the state in which row t's action was chosen, that of the row's observation. There are as many frames as
  rows, and the state after the last step has none.
- A replay that differs from the episode in any reward or flag yields no video, since it would show another episode.
- One episode at a time: a framed `Order` on standard input, a framed `Made` on the original standard output. Output of
  simulators and drivers goes to standard error.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterable, Iterator
from typing import BinaryIO

import msgspec
import numpy as np

from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import WorkerError
from evopolicy_common.installation import add_extra
from evopolicy_common.messages.environment import Case
from evopolicy_common.records.episodes.trajectory import decode
from evopolicy_worker import environments
from evopolicy_worker.environments import Environment, Frame
from evopolicy_worker.slot_protocol.child_pipes import take_pipes
from evopolicy_worker.slot_protocol.slot_messages import LENGTH

CRF = 28
"""x264's constant rate factor: 200 frames of 600 × 400 come to some 66 KiB."""
PRESET = "veryfast"
MIN_RATE, MAX_RATE = 4, 30
"""Frames a second."""
EPISODE_S = 10
"""Target duration of the video of a full-length episode, seconds, if the frame rates allow it."""


class Order(msgspec.Struct, frozen=True, kw_only=True):
    """The episode to record."""

    case: Case
    actions: bytes
    """`trajectory` codec bytes with record "actions": the repaired actions and their results."""


class Made(msgspec.Struct, frozen=True, kw_only=True):
    """The answer to an order."""

    mp4: bytes | None
    error: str = ""
    """Why there is no video."""


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


def rate_of(max_episode_steps: int) -> int:
    """Frames a second, by the environment alone, so that videos of one environment run side by side."""
    return max(MIN_RATE, min(MAX_RATE, max_episode_steps // EPISODE_S))


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
    decoder = msgspec.msgpack.Decoder(Order)
    while head := orders.read(LENGTH.size):
        order = decoder.decode(orders.read(LENGTH.unpack(head)[0]))
        try:
            if environment is None:
                environment = environments.make(env_id, render=True)
            rate = rate_of(environment.description.max_episode_steps)
            made = Made(mp4=encoded(replay(environment, order.case, order.actions), rate))
        except Exception as error:
            # Drivers and simulators raise any exception here, and a missing picture is no failure of the episode.
            what = str(error) if isinstance(error, WorkerError) else f"{type(error).__name__}: {error}"
            made = Made(mp4=None, error=what)
        data = msgspec.msgpack.encode(made)
        replies.write(LENGTH.pack(len(data)) + data)
        replies.flush()


def main() -> None:
    """The process's entry."""
    orders, replies = take_pipes()
    with os.fdopen(orders, "rb") as reader, os.fdopen(replies, "wb") as writer:
        env_id, *definitions = sys.argv[1:]
        environments.define(msgspec.json.decode(each, type=Entry) for each in definitions)
        serve(env_id, reader, writer)
        # Not by way of exit handlers, of which a graphics driver's may hang or crash.
        os._exit(0)


if __name__ == "__main__":
    main()
