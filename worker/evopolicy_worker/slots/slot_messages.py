"""What a slot and its environment process say to each other over their pipes: length-prefixed msgpack."""

from __future__ import annotations

import struct

import msgspec

from evopolicy_common.catalogue import Entry
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import EpisodeOutcome, Job, PolicyFailure, Tier
from evopolicy_worker.episodes.begun import PackedBegun

LENGTH = struct.Struct("<I")
NOTE = "note: "
"""Begins a line on the process's standard error that an operator should see."""


class Message(msgspec.Struct, frozen=True, kw_only=True, tag_field="op"):
    """One message; `op` names its type."""


class Start(Message, frozen=True, kw_only=True, tag="start"):
    """The first message: what kind of slot to be."""

    tier: Tier
    core: int | None
    scratch: str
    allowed_packages: tuple[str, ...]
    user: int | None
    """As root: who policies, and the process once it is sealed, are outside the jail."""
    draws: bool = False
    """With the graphics devices of this machine."""
    sealed: bool = True
    definitions: tuple[Entry, ...] = ()
    """Environments that do not ship."""


class Files(msgspec.Struct, frozen=True, kw_only=True):
    """A bundle, which the process has no file of."""

    key: str
    names: list[tuple[str, bool, int]] | None
    """Path, executable, size in bytes of each; None: the process was sent this bundle last."""
    data: bytes
    """Their contents, one after another."""


class Play(Message, frozen=True, kw_only=True, tag="play"):
    """Play this job; answered by Told, again and again, Finished for each episode, then by Played or Fault (or, given up, by
    Begun before these)."""

    job: Job
    bundle: Files | None
    first: int = 0
    """The episode to begin with, counted in the job."""
    failure: PolicyFailure | None = None
    """Of the policy in that episode: it brought down the process that played it before."""


class Describe(Message, frozen=True, kw_only=True, tag="describe"):
    """Say what these environments are; answered by Described or Fault."""

    environments: tuple[str, ...]


class Cancel(Message, frozen=True, kw_only=True, tag="cancel"):
    """Stop the running job, which is answered by Played."""


class Ready(Message, frozen=True, kw_only=True, tag="ready"):
    """Started, sandbox and all."""


class Told(Message, frozen=True, kw_only=True, tag="progress"):
    """How far the running job is."""

    episodes_done: int
    steps: int


class Acting(Message, frozen=True, kw_only=True, tag="acting"):
    """The first action of a policy is about to reach the environment in the job's next episode."""


class Finished(Message, frozen=True, kw_only=True, tag="finished"):
    """What came of the job's next episode."""

    outcome: EpisodeOutcome
    begun: PackedBegun | None = None
    """What the policy returned in it; of jobs of several episodes only, which are given back as a whole."""


class Begun(Message, frozen=True, kw_only=True, tag="begun"):
    """What the policy has returned so far in the episode that is given up: told on Cancel, and before a Fault."""

    place: int
    """The episode's, counted in the job."""
    begun: PackedBegun


class Played(Message, frozen=True, kw_only=True, tag="played"):
    """The job is done: every episode of it has been told, or it was cancelled."""

    cancelled: bool = False


class Described(Message, frozen=True, kw_only=True, tag="described"):
    """The environments that were asked for, in their order."""

    environments: tuple[EnvironmentDescription, ...]


class Fault(Message, frozen=True, kw_only=True, tag="fault"):
    """Our own failure, never the policy's."""

    kind: str
    """`sandbox` or `worker`."""
    message: str


Command = Start | Play | Describe | Cancel
Answer = Ready | Told | Acting | Finished | Begun | Played | Described | Fault

encoder = msgspec.msgpack.Encoder()
commands: msgspec.msgpack.Decoder[Command] = msgspec.msgpack.Decoder(Command)
answers: msgspec.msgpack.Decoder[Answer] = msgspec.msgpack.Decoder(Answer)


def framed(message: Message) -> bytes:
    """A message's bytes with their length before them."""
    data = encoder.encode(message)
    return LENGTH.pack(len(data)) + data
