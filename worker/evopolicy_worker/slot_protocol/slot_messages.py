"""Messages between a slot and its environment process over their pipes: length-prefixed msgpack."""

from __future__ import annotations

import struct

import msgspec

from evopolicy_common.catalogue import Entry
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, Job, PolicyFailure, Tier
from evopolicy_worker.environments.interface.calls import Limits
from evopolicy_worker.slot_protocol.begun import PackedBegun

LENGTH = struct.Struct("<I")


class Message(msgspec.Struct, frozen=True, kw_only=True, tag_field="op"):
    """A message; `op` names its type."""


class Start(Message, frozen=True, kw_only=True, tag="start"):
    """The first message: how to set up the slot. Answered by Ready or Fault."""

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
    limits: Limits = Limits()
    """Of the environments."""


class Files(msgspec.Struct, frozen=True, kw_only=True):
    """A bundle's files, which the process cannot read from disk."""

    key: str
    names: list[tuple[str, bool, int]] | None
    """Path, executable flag and size in bytes of each file. None: this bundle is the one that was sent last."""
    data: bytes
    """The files' contents, concatenated."""


class Play(Message, frozen=True, kw_only=True, tag="play"):
    """Play this job. The replies are any number of Progress; for each episode Acting, when its policy's first action
    is due, and Finished; Begun when an episode is stopped; Filmed for each video; and last Played or Fault."""

    job: Job
    bundle: Files | None
    first: int = 0
    """Index in the job of the first episode to play."""
    failure: PolicyFailure | None = None
    """The policy's failure in that episode: it crashed the process that played it before."""


class Describe(Message, frozen=True, kw_only=True, tag="describe"):
    """Describe these environments. Answered by Described or Fault."""

    environments: tuple[str, ...]


class Cancel(Message, frozen=True, kw_only=True, tag="cancel"):
    """Stop the running job, which then ends with Played."""


class Ready(Message, frozen=True, kw_only=True, tag="ready"):
    """The process and its sandbox have started."""


class Progress(Message, frozen=True, kw_only=True, tag="progress"):
    """Progress of the running job."""

    episodes_done: int
    steps: int


class Acting(Message, frozen=True, kw_only=True, tag="acting"):
    """In the job's next episode, the first action of the policy is about to reach the environment."""


class Finished(Message, frozen=True, kw_only=True, tag="finished"):
    """The outcome of the job's next episode."""

    outcome: EpisodeOutcome
    begun: PackedBegun | None = None
    """The policy's actions in it. Only in jobs of several episodes, which are returned as a whole."""
    unused: bytes = b""
    """The feedback of a hidden episode, which nobody reads: with policy scope "submit" it is sent as that of a train
    episode is, since the policy can measure the time."""


class Filmed(Message, frozen=True, kw_only=True, tag="filmed"):
    """The video of one of the job's finished episodes."""

    place: int
    """The episode's index in the job."""
    video: BlobRef


class Begun(Message, frozen=True, kw_only=True, tag="begun"):
    """The policy's actions so far in a stopped episode. Sent on Cancel, and before a Fault."""

    place: int
    """The episode's index in the job."""
    begun: PackedBegun


class Played(Message, frozen=True, kw_only=True, tag="played"):
    """The job is over: every episode has been reported by Finished, or it was cancelled."""

    cancelled: bool = False


class Described(Message, frozen=True, kw_only=True, tag="described"):
    """The requested environments, in the order of the request."""

    environments: tuple[EnvironmentDescription, ...]


class Fault(Message, frozen=True, kw_only=True, tag="fault"):
    """An infrastructure failure, never the policy's."""

    kind: str
    """`sandbox`, `environment` or `worker`."""
    message: str


Command = Start | Play | Describe | Cancel
Reply = Ready | Progress | Acting | Finished | Filmed | Begun | Played | Described | Fault

encoder = msgspec.msgpack.Encoder()
commands: msgspec.msgpack.Decoder[Command] = msgspec.msgpack.Decoder(Command)
replies: msgspec.msgpack.Decoder[Reply] = msgspec.msgpack.Decoder(Reply)


def framed(message: Message) -> bytes:
    """The encoded message, prefixed by its length."""
    data = encoder.encode(message)
    return LENGTH.pack(len(data)) + data
