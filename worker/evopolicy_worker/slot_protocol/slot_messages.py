"""Messages between a slot and its environment process over their pipes: length-prefixed msgpack."""

from __future__ import annotations

import os
import signal
import struct

import msgspec

from evopolicy_common.catalogue import Entry
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, Job, PolicyFailure, Tier
from evopolicy_common.processes.parent_death import end_with_parent
from evopolicy_worker.environments.interface.calls import EnvironmentLimits
from evopolicy_worker.slot_protocol.begun import PackedBegun

LENGTH = struct.Struct("<I")


class SlotMessage(msgspec.Struct, frozen=True, kw_only=True, tag_field="op", tag=str.lower):
    """A message; `op` names its type."""


class SlotStart(SlotMessage, frozen=True, kw_only=True):
    """The first message: how to set up the slot. Answered by SlotReady or Fault."""

    tier: Tier
    core: int | None
    scratch: str
    allowed_packages: tuple[str, ...]
    user: int | None
    """As root: the user id outside the jail of policies, and of the process once it is sealed."""
    draws: bool = False
    """Whether the jail shows this machine's graphics devices."""
    sealed: bool = True
    definitions: tuple[Entry, ...] = ()
    """Environments that do not ship."""
    limits: EnvironmentLimits = EnvironmentLimits()
    """Of the environments."""


class BundleFiles(msgspec.Struct, frozen=True):
    """A bundle's files, which the process cannot read from disk."""

    names: list[tuple[str, bool, int]]
    """Path, executable flag and size in bytes of each file."""
    data: bytes
    """The files' contents, concatenated."""


class Play(SlotMessage, frozen=True, kw_only=True):
    """Play this job. The replies are any number of JobProgress; for each episode Acting, when its policy's first action
    is due, and Finished; Begun when an episode is stopped; Filmed for each video; and last Played or Fault."""

    job: Job
    bundle: BundleFiles | None
    """None: the job has none, or the one that was sent last."""
    first: int = 0
    """Index in the job of the first episode to play."""
    failure: PolicyFailure | None = None
    """The policy's failure in that episode: it crashed the process that played it before."""


class Describe(SlotMessage, frozen=True, kw_only=True):
    """Describe these environments. Answered by Described or Fault."""

    environments: tuple[str, ...]


class Cancel(SlotMessage, frozen=True, kw_only=True):
    """Stop the running job, which then ends with Played."""


class SlotReady(SlotMessage, frozen=True, kw_only=True):
    """The process and its sandbox have started."""


class JobProgress(SlotMessage, frozen=True, kw_only=True):
    episodes_done: int
    steps: int


class Acting(SlotMessage, frozen=True, kw_only=True):
    """In the job's next episode, the first action of the policy is about to reach the environment."""


class Finished(SlotMessage, frozen=True, kw_only=True):
    """The outcome of the job's next episode."""

    outcome: EpisodeOutcome
    begun: PackedBegun | None = None
    """The policy's actions in it. Only in jobs of several episodes, which are returned as a whole."""
    unused: bytes = b""
    """The feedback of a hidden episode, which nobody reads: with policy scope "submit" it is sent as that of a train
    episode is, since the policy can measure the time."""


class Filmed(SlotMessage, frozen=True, kw_only=True):
    """The video of one of the job's finished episodes."""

    place: int
    """The episode's index in the job."""
    video: BlobRef


class Begun(SlotMessage, frozen=True, kw_only=True):
    """The policy's actions so far in a stopped episode. Sent on Cancel, and before a Fault."""

    place: int
    """The episode's index in the job."""
    begun: PackedBegun


class Played(SlotMessage, frozen=True, kw_only=True):
    """The job is over: every episode has been reported by Finished, or it was cancelled."""

    cancelled: bool = False


class Described(SlotMessage, frozen=True, kw_only=True):
    """The requested environments, in the order of the request."""

    environments: tuple[EnvironmentDescription, ...]


class Fault(SlotMessage, frozen=True, kw_only=True):
    """An infrastructure failure, never the policy's."""

    kind: str
    """`sandbox`, `environment` or `worker`."""
    message: str


Command = SlotStart | Play | Describe | Cancel
Reply = SlotReady | JobProgress | Acting | Finished | Filmed | Begun | Played | Described | Fault

commands: msgspec.msgpack.Decoder[Command] = msgspec.msgpack.Decoder(Command)
replies: msgspec.msgpack.Decoder[Reply] = msgspec.msgpack.Decoder(Reply)
encoder = msgspec.msgpack.Encoder()


def framed(message: msgspec.Struct) -> bytes:
    """The encoded message, prefixed by its length."""
    data = encoder.encode(message)
    return LENGTH.pack(len(data)) + data


def unframed(received: bytearray) -> list[bytes]:
    """Takes the complete messages out of the bytes that have arrived."""
    complete: list[bytes] = []
    size = LENGTH.size
    while len(received) >= size and len(received) >= (end := size + LENGTH.unpack_from(received)[0]):
        complete.append(bytes(received[size:end]))
        del received[:end]
    return complete


def take_pipes() -> tuple[int, int]:
    """In a worker's child process: moves standard input and output to new descriptors and returns these, for
    commands and answers.

    From now on standard input is empty, and prints of simulators and drivers go to standard error. Ctrl-C and SIGTERM
    are ignored; the parent handles them, and this process ends with its parent.
    """
    end_with_parent(signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A batch system sends it to all processes of a job. Processes started from here inherit this. So does a
    # policy, whose failure it would be otherwise.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    commands, replies = os.dup(0), os.dup(1)
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(2, 1)
    return commands, replies
