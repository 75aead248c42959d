"""Who was alive where, as a tapped coordinator's questions and answers tell it: agents by their permits, episodes by
leases."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import msgspec

from attacks.golden_run import GoldenCluster
from evopolicy_common.messages import gateway, worker
from evopolicy_common.wire import codec


class Moment(msgspec.Struct, frozen=True):
    """The events, in the order in which the coordinator received requests and replied."""

    what: str
    """`permit` granted, `close` asked, `hidden` or `train` leased, `done` reported or given up."""
    who: str
    """The run; of an episode its lease."""


def moments(cluster: GoldenCluster) -> list[Moment]:
    """Everything of permits and leases that crossed so far."""
    hidden = {case.seed for split in ("valid", "heldout") for case in cluster.cases[split]}
    found: list[Moment] = []
    for way, key, payload in cluster.crossed(""):
        room, _, tail = key.partition("/v1/")[2].partition("/")[2].partition("/")
        if room == "gw":
            run, verb = tail.split("/")
            if way == "answer" and verb == "permit":
                answer = codec.decode(codec.gateway_replies, payload)
                if isinstance(answer, gateway.Permit) and answer.granted:
                    found.append(Moment("permit", run))
            elif way == "question" and verb == "close":
                found.append(Moment("close", run))
        elif room == "work" and way == "answer":
            reply = codec.decode(codec.worker_replies, payload)
            if isinstance(reply, worker.Leases):
                found += [
                    Moment(
                        "hidden"
                        # Random actions tell nothing of a case to a policy.
                        if lease.job.bundle is not None and lease.job.episodes[0].case.seed in hidden
                        else "train",
                        lease.lease_id,
                    )
                    for lease in reply.leases
                    if lease.job.bundle is not None
                ]
            if isinstance(reply, worker.Leases | worker.HeartbeatReply):
                found += [Moment("done", lease) for lease in reply.cancelled]
        elif room == "work":
            message = codec.decode(codec.worker_requests, payload)
            if isinstance(message, worker.ReportResults):
                found += [Moment("done", result.lease_id) for result in message.results]
    return found


def met(cluster: GoldenCluster, moments: Sequence[Moment], elsewhere: Sequence[str] = ()) -> list[str]:
    """Where a hidden episode and a related agent, or a related train episode, were on the worker's machine together.

    All runs are related, and there is one worker. `elsewhere`: runs whose agents are on another kernel.
    """
    agents: dict[str, None] = {}
    playing: dict[str, dict[str, None]] = {"hidden": {}, "train": {}}
    found = []
    for moment in moments:
        if moment.what == "permit" and moment.who not in elsewhere:
            agents[moment.who] = None
        elif moment.what == "close":
            agents.pop(moment.who, None)
        elif moment.what == "done":
            for episodes in playing.values():
                episodes.pop(moment.who, None)
        elif moment.what in playing:
            playing[moment.what][moment.who] = None
        together = [name for name, there in (("agent", agents), ("train", playing["train"])) if there]
        if playing["hidden"] and together:
            found.append(f"{moment.what} {moment.who}: hidden episodes beside {' and '.join(together)}")
    return found


def heard_by(folder: Path) -> dict[str, list[float]]:
    """The lines that a listening agent has written so far; none before it listens."""
    path = folder / "workspace" / "heard.json"
    return json.loads(path.read_text()) if path.exists() else {}
