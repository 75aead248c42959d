"""The address that serves a remote agent (`run --agent remote --http HOST:PORT`), and the machine of an agent.

- The service listens on an address other than loopback only when the operator names it. Then every request needs the
  bearer token, even on loopback.
- The token is a file of mode 0600 beside the gateway's other secrets; it never appears in a command's arguments or
  output.
- An agent that is not started here counts as present on every machine unless its operator names one, and as alive until
  the operator reports its end.
"""

from __future__ import annotations

import contextlib
import ipaddress
import platform
import re
from pathlib import Path
from urllib.parse import urlsplit

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.operator import CreateRun
from evopolicy_common.messages.run_settings import ELSEWHERE
from evopolicy_common.processes import proc
from evopolicy_common.wire.credentials import host_and_port
from evopolicy_gateway.run_folder.layout import RunFolder, saved

AGENT = "remote"
"""Value of `--agent` for an agent that is started elsewhere."""
TOKEN_VARIABLE = "EVOPOLICYGYM_TOKEN"
"""Variable with the agent's bearer token, as the staged rules name it."""
_BOOT_ID = re.compile(r"[0-9a-fA-F]{8}(-[0-9a-fA-F]{4}){3}-[0-9a-fA-F]{12}")


class Listener(msgspec.Struct, frozen=True, kw_only=True):
    """The operator's choice of address."""

    host: str
    """Address or name of this machine."""
    port: int
    url: str = ""
    """URL for the agent when it is not `http://host:port`: a TLS proxy, a forwarded port. Without a trailing `/`."""


class AgentPlace(msgspec.Struct, frozen=True, kw_only=True):
    """The kernel that an agent runs on, as sent in `RequestPermit`."""

    boot_id: str = ""
    """Empty: unknown, which counts as every kernel."""
    host: str = ""


def listener_of(http: str, url: str | None) -> Listener:
    """Parses `--http HOST:PORT` and `--http-url`. Raises ConfigError for invalid values."""
    address, port = host_and_port("--http", http, "10.0.0.5:8080; port 0 takes a free one")
    if url is None:
        wildcard = False
        with contextlib.suppress(ValueError):  # a name
            wildcard = ipaddress.ip_address(address).is_unspecified
        if wildcard:
            raise ConfigError(
                f"--http {http}: an agent cannot connect to a wildcard address; name an address of this machine, or"
                " give the URL with --http-url"
            )
        return Listener(host=address, port=port)
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.query or parts.fragment:
        raise ConfigError(f"--http-url {url!r}: use the form https://HOST or https://HOST:PORT/PATH")
    if any(not (letter.isalnum() or letter in "-._~:/[]%") for letter in url):
        raise ConfigError(f"--http-url {url!r}: must be a plain URL, without quotes and spaces")
    return Listener(host=address, port=port, url=url.rstrip("/"))


def check_agent(agent: str, listener: Listener | None) -> None:
    """Raises ConfigError for a remote agent without a listener, or a listener without a remote agent."""
    if agent == AGENT and listener is None:
        raise ConfigError(
            "--agent remote needs --http HOST:PORT: where the run is served; it goes with `evopolicy run` alone"
        )
    if agent != AGENT and listener is not None:
        raise ConfigError("--http applies only with --agent remote; a local agent is served on loopback")


def agent_host_of(agent: str, named: str | None) -> str:
    """Parses `--agent-host`: boot id or `ELSEWHERE`; empty for None. ConfigError, also for local agents."""
    if named is None:
        return ""
    if agent != AGENT:
        raise ConfigError("--agent-host applies only with --agent remote; a local agent is on this machine")
    if named != ELSEWHERE and not _BOOT_ID.fullmatch(named):
        raise ConfigError(
            f"--agent-host {named!r}: give the boot id of the agent's machine (there: cat"
            f" /proc/sys/kernel/random/boot_id), or `{ELSEWHERE}` when it is on no machine of the cluster"
        )
    return named if named == ELSEWHERE else named.lower()


def agent_place(folder: RunFolder) -> AgentPlace:
    """The place of an open run's agent: the gateway's kernel, unless the agent is started elsewhere."""
    if not folder.listener.exists():
        return AgentPlace(boot_id=proc.boot_id(), host=platform.node())
    named = _agent_host(folder)
    return AgentPlace(boot_id="" if named == ELSEWHERE else named)


def ends_unseen(folder: RunFolder) -> bool:
    """Whether only the operator can report the agent's end: it was not started here and may be on a cluster machine."""
    return folder.listener.exists() and _agent_host(folder) != ELSEWHERE


def _agent_host(folder: RunFolder) -> str:
    with contextlib.suppress(FileNotFoundError):
        return saved(folder.intended, CreateRun).settings.agent_host
    return ""


def place_notice(agent_host: str, root: Path) -> str:
    """Explains to the operator of a remote agent the effect of `--agent-host`."""
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
    """Reports the end of an open run's agent. Raises ConfigError unless the agent is remote."""
    if not folder.listener.exists():
        raise ConfigError(
            f"{folder.root} is no open run of a remote agent; name its run directory, or wait for an agent that a"
            " command started"
        )
    folder.finish.touch(mode=0o600)
