"""Where a run is served when its agent is in a container or on another host, `run --agent remote --http HOST:PORT`, and where
an agent is alive.

Rules: an address is listened on only because the operator named it; then every request needs the bearer token, on loopback
too; the token is a file of mode 0600 beside the gateway's other secrets, and no command's argument or output. An agent that
is not started here counts as being on every machine unless its operator says which, and as alive until he says that it is not.
"""

from __future__ import annotations

import ipaddress
import platform
import re
from pathlib import Path
from urllib.parse import urlsplit

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.operator import ELSEWHERE
from evopolicy_common.processes import host
from evopolicy_gateway.run.layout import IntendedRun, RunFolder, saved

AGENT = "remote"
"""What `--agent` calls an agent that somebody else starts."""
TOKEN_VARIABLE = "EVOPOLICYGYM_TOKEN"
"""Where the staged rules tell an agent to find its bearer token."""
_BOOT_ID = re.compile(r"[0-9a-fA-F]{8}(-[0-9a-fA-F]{4}){3}-[0-9a-fA-F]{12}")


class Listener(msgspec.Struct, frozen=True, kw_only=True):
    """What the operator chose."""

    host: str
    """An address of this machine, or a name of it."""
    port: int
    url: str = ""
    """How the agent reaches it where that is not `http://host:port`: a TLS front, a forwarded port. No `/` at its end."""


class AgentPlace(msgspec.Struct, frozen=True, kw_only=True):
    """The kernel that an agent runs on, as `RequestPermit` tells it."""

    boot_id: str = ""
    """Empty: unknown, which counts as every kernel."""
    machine_id: str = ""
    host: str = ""


def listener_of(http: str, url: str | None) -> Listener:
    """The door of `--http HOST:PORT` and `--http-url`. ConfigError for what is none."""
    address, colon, port = http.rpartition(":")
    address = address.removeprefix("[").removesuffix("]")
    if not colon or not address or not port.isdecimal() or not 0 <= int(port) < 1 << 16:
        raise ConfigError(
            f"--http {http!r}: say it as HOST:PORT, such as 10.0.0.5:8080; port 0 takes a free one"
        )
    if url is None:
        if _is_wildcard(address):
            raise ConfigError(
                f"--http {http}: an agent cannot dial every address; name one, or say with --http-url how it is reached"
            )
        return Listener(host=address, port=int(port))
    found = urlsplit(url)
    if found.scheme not in ("http", "https") or not found.hostname or found.query or found.fragment:
        raise ConfigError(f"--http-url {url!r}: say it as https://HOST or https://HOST:PORT/PATH")
    if any(not (letter.isalnum() or letter in "-._~:/[]%") for letter in url):
        raise ConfigError(f"--http-url {url!r}: letters of a plain URL only, no quotes and no spaces")
    return Listener(host=address, port=int(port), url=url.rstrip("/"))


def check_agent(agent: str, listener: Listener | None) -> None:
    """ConfigError where a remote agent has no door, or a door no remote agent."""
    if (agent == AGENT) == (listener is not None):
        return
    if listener is None:
        raise ConfigError(
            "--agent remote needs --http HOST:PORT: where the run is served; it goes with `evopolicy run` alone"
        )
    raise ConfigError("--http goes with --agent remote; an agent that is started here is served on loopback")


def agent_host_of(agent: str, named: str) -> str:
    """The kernel that `--agent-host` names, or `ELSEWHERE`. ConfigError for what is neither."""
    if agent != AGENT:
        raise ConfigError(
            "--agent-host goes with --agent remote; an agent that is started here is alive on this machine"
        )
    if named != ELSEWHERE and not _BOOT_ID.fullmatch(named):
        raise ConfigError(
            f"--agent-host {named!r}: give the boot id of the agent's machine (there: cat"
            f" /proc/sys/kernel/random/boot_id), or `{ELSEWHERE}` when it is on no machine of the cluster"
        )
    return named if named == ELSEWHERE else named.lower()


def place_of(named: str) -> AgentPlace:
    """The place of `evopolicy-gateway --agent-host`. ConfigError for what names none."""
    if named == "unknown":
        return AgentPlace()
    if not _BOOT_ID.fullmatch(named):
        raise ConfigError(
            f"--agent-host {named!r}: give the boot id of the agent's machine (there: cat"
            " /proc/sys/kernel/random/boot_id), or `unknown`"
        )
    return AgentPlace(boot_id=named.lower())


def agent_place(folder: RunFolder) -> AgentPlace:
    """Where the agent of an open run is alive: where its gateway is, unless somebody else starts it."""
    if not folder.listener.exists():
        return AgentPlace(boot_id=host.boot_id(), machine_id=host.machine_id(), host=platform.node())
    named = _agent_host(folder)
    return AgentPlace(boot_id="" if named == ELSEWHERE else named)


def ends_unseen(folder: RunFolder) -> bool:
    """Whether only the operator can tell that the agent has ended: it is on machines that count, and not in our hands."""
    return folder.listener.exists() and _agent_host(folder) != ELSEWHERE


def _agent_host(folder: RunFolder) -> str:
    try:
        return saved(folder.intended, IntendedRun).settings.agent_host
    except FileNotFoundError:
        return ""


def said_of_place(agent_host: str, root: Path) -> str:
    """What `--agent-host` means for a remote agent's run, for its operator."""
    if agent_host == ELSEWHERE:
        return "you vouch that the agent is on no machine of the cluster: run.json will say hidden_isolation: waived"
    until = f"has ended and you have said so: evopolicy finish {root}"
    if agent_host:
        return f"no hidden case that this run shares is played on kernel {agent_host} until the agent {until}"
    return (
        "no --agent-host names the agent's machine, so it may be any: no hidden case that this run shares is played"
        f" anywhere until the agent {until}"
    )


def finish(folder: RunFolder) -> None:
    """Says that the agent of an open run has ended. ConfigError where there is none that only the operator can see."""
    if not folder.listener.exists() and not folder.unwatched.exists():
        raise ConfigError(f"{folder.root} is no open run of a remote agent, nor of one that nobody watches")
    folder.finish.touch(mode=0o600)


def _is_wildcard(address: str) -> bool:
    try:
        return ipaddress.ip_address(address).is_unspecified
    except ValueError:
        return False
