"""An agent without a jail that takes its gateway's credentials, opens a Zenoh session of its own, and listens to
everything."""

import json
import os
import sys
import time
import urllib.request

import msgspec
import zenoh

from evopolicy_common.messages.gateway import StateRequest
from evopolicy_common.messages.status import StatusRequest
from evopolicy_common.wire import codec, keys, transport
from evopolicy_common.wire.credentials import Credentials


def fail(*what):
    """A traceback, and the end: Zenoh's threads would keep a program that is over."""
    sys.__excepthook__(*what)
    sys.stderr.flush()
    os._exit(1)


sys.excepthook = fail
with open("../.gateway/credentials.json", "rb") as file:
    stolen = msgspec.json.decode(file.read(), type=Credentials)
with open("../.gateway/intended.json", "rb") as file:
    run = json.load(file)["run"]
# Two, since what a session asks reaches its own ears.
session, listener = (zenoh.open(transport.client_config(stolen)) for _ in range(2))
heard = []


def hear(what):
    def note(message):
        heard.append(f"{what} {message.key_expr}")

    return note


held = [listener.declare_subscriber(key, hear("sample")) for key in ("**", "evopolicy/**", "@/**")]
held += [
    listener.declare_queryable(key, hear("query"), complete=True)
    for key in ("**", keys.requests(stolen.cluster)["gateway"], keys.requests(stolen.cluster)["worker"])
]
held += [listener.liveliness().declare_subscriber("**", hear("token"), history=True)]


def ask(key, payload):
    """The kind of the first answer; None where there is none."""
    for reply in session.get(key, payload=payload, timeout=3.0):
        if reply.ok is not None:
            return msgspec.msgpack.decode(bytes(reply.ok.payload))["op"]
    return None


def spaces():
    """Admin spaces that answer, other than those which Zenoh keeps inside this agent's own two sessions."""
    mine = {str(each.info.zid()) for each in (session, listener)}
    found = {
        str(reply.ok.key_expr).split("/")[1]
        for reply in session.get("@/**", timeout=3.0)
        if reply.ok is not None
    }
    return sorted(found - mine)


def live():
    replies = [reply for reply in session.liveliness().get("**", timeout=3.0) if reply.ok is not None]
    return str(replies) if replies else None


state = codec.encode(StateRequest(run=run, token=stolen.token))
cluster = stolen.cluster
answers = {
    "own state": ask(keys.gateway_key(cluster, run, "state"), state),
    "status of the cluster": ask(keys.operator_key(cluster, "status"), codec.encode(StatusRequest(token=""))),
    "work": ask(keys.worker_key(cluster, "lease"), b""),
    "every key": ask("**", state),
    "admin spaces": spaces(),
    "liveliness": live(),
    "another run": ask(
        keys.gateway_key(cluster, "r-0000000000000000", "state"),
        codec.encode(StateRequest(run="r-0000000000000000", token=stolen.token)),
    ),
}
open("listening", "w").close()
while not os.path.exists("enough"):
    time.sleep(0.05)
body = json.dumps({"env_instances": [0]}).encode()
urllib.request.urlopen(urllib.request.Request(os.environ["EVOPOLICYGYM_SUBMIT_URL"], data=body)).read()
with open("report.json", "w") as file:
    json.dump({"connected": bool(session.info.routers_zid()), "heard": heard, "answers": answers}, file)
os._exit(0)  # Zenoh's threads would keep it
