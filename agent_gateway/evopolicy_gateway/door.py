"""Where a run is served when its agent is in a container or on another host: `run --agent remote --http HOST:PORT`.

Rules: an address is listened on only because the operator named it; then every request needs the bearer token, on loopback
too; the token is a file of mode 0600 beside the gateway's other secrets, and no command's argument or output.
"""

from __future__ import annotations

import ipaddress
import re
from urllib.parse import urlsplit

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.operator import ELSEWHERE
from evopolicy_gateway.layout import RunFolder

AGENT = "remote"
"""What `--agent` calls an agent that somebody else starts."""
TOKEN_VARIABLE = "EVOPOLICYGYM_TOKEN"
"""Where the staged rules tell an agent to find its bearer token."""
_BOOT_ID = re.compile(r"[0-9a-fA-F]{8}(-[0-9a-fA-F]{4}){3}-[0-9a-fA-F]{12}")


class Door(msgspec.Struct, frozen=True, kw_only=True):
    """What the operator chose."""

    host: str
    """An address of this machine, or a name of it."""
    port: int
    url: str = ""
    """How the agent reaches it where that is not `http://host:port`: a TLS front, a forwarded port. No `/` at its end."""


def door_of(http: str, url: str | None) -> Door:
    """The door of `--http HOST:PORT` and `--http-url`. ConfigError for what is none."""
    host, colon, port = http.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not colon or not host or not port.isdecimal() or not 0 <= int(port) < 1 << 16:
        raise ConfigError(
            f"--http {http!r}: say it as HOST:PORT, such as 10.0.0.5:8080; port 0 takes a free one"
        )
    if url is None:
        if _is_wildcard(host):
            raise ConfigError(
                f"--http {http}: an agent cannot dial every address; name one, or say with --http-url how it is reached"
            )
        return Door(host=host, port=int(port))
    found = urlsplit(url)
    if found.scheme not in ("http", "https") or not found.hostname or found.query or found.fragment:
        raise ConfigError(f"--http-url {url!r}: say it as https://HOST or https://HOST:PORT/PATH")
    if any(not (letter.isalnum() or letter in "-._~:/[]%") for letter in url):
        raise ConfigError(f"--http-url {url!r}: letters of a plain URL only, no quotes and no spaces")
    return Door(host=host, port=int(port), url=url.rstrip("/"))


def check_agent(agent: str, door: Door | None) -> None:
    """ConfigError where a remote agent has no door, or a door no remote agent."""
    if (agent == AGENT) == (door is not None):
        return
    if door is None:
        raise ConfigError(
            "--agent remote needs --http HOST:PORT: where the run is served; it goes with `evopolicy run` alone"
        )
    raise ConfigError("--http goes with --agent remote; an agent that is started here is served on loopback")


def agent_host_of(agent: str, host: str) -> str:
    """The kernel that `--agent-host` names, or `ELSEWHERE`. ConfigError for what is neither."""
    if agent != AGENT:
        raise ConfigError(
            "--agent-host goes with --agent remote; an agent that is started here is alive on this machine"
        )
    if host != ELSEWHERE and not _BOOT_ID.fullmatch(host):
        raise ConfigError(
            f"--agent-host {host!r}: give the boot id of the agent's machine (there: cat"
            f" /proc/sys/kernel/random/boot_id), or `{ELSEWHERE}` when it is on no machine of the cluster"
        )
    return host if host == ELSEWHERE else host.lower()


def finish(folder: RunFolder) -> None:
    """Says that the remote agent of an open run is done. ConfigError where there is none."""
    if not folder.door.exists():
        raise ConfigError(f"{folder.root} is no open run of a remote agent")
    folder.finish.touch(mode=0o600)


def _is_wildcard(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return False
