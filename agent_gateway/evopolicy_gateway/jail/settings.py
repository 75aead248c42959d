"""The operator's settings of an agent's jail, checked before anything is started."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal, get_args
from urllib.parse import urlsplit

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_common.processes import distribution
from evopolicy_common.records.open_run import STATE
from evopolicy_gateway.declared import Option, Several
from evopolicy_gateway.jail.syscalls import GIVE_UP, filter_program

Mode = Literal["bwrap", "open-network", "none"]
Host = tuple[str, int]
"""Name and port of a host."""

HTTPS = 443
_HOST = re.compile(r"(?P<name>[A-Za-z0-9](?:[A-Za-z0-9.-]*[A-Za-z0-9])?)(?::(?P<port>[0-9]{1,5}))?")
_VARIABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_TIMEOUT_S = 30.0
_STATE_FOLDERS = tuple("*/" * depth + STATE for depth in range(4))


def _several(flag: str, metavar: str, parse: Callable[[list[str]], tuple[str, ...]] = tuple) -> Option:
    return Option(flag=flag, metavar=metavar, command=Several, parse=parse)


def _here(paths: list[str]) -> tuple[str, ...]:
    return tuple(absolute(path, Path.cwd()) for path in paths)


class JailSettings(msgspec.Struct, frozen=True, kw_only=True):
    """The jail of one run's agent."""

    group: ClassVar[str] = "Agent's jail"

    mode: Annotated[Mode, Option(flag="--jail")] = "bwrap"
    """Jail of the agent; open-network: a jail with this machine's network. Recorded in run.json."""
    read: Annotated[tuple[str, ...], _several("--jail-bind", "PATH", _here)] = ()
    """File or folder that the agent may read."""
    write: Annotated[tuple[str, ...], _several("--jail-bind-rw", "PATH", _here)] = ()
    """File or folder that the agent may also change."""
    environment: Annotated[tuple[str, ...], _several("--jail-env", "NAME")] = ()
    """Environment variable that the agent gets, such as an API key."""
    hosts: Annotated[tuple[str, ...], _several("--allow-host", "HOST[:PORT]")] = ()
    """Host that the agent may connect to, in addition to its model's."""

    @property
    def recorded(self) -> str:
        """The text for `run.json`."""
        return {"bwrap": "bwrap", "open-network": "bwrap, open network", "none": "none"}[self.mode]

    def chosen(self) -> dict[str, list[str]]:
        """The operator's additions to the jail, for `run.json`."""
        given = {"read": self.read, "write": self.write, "environment": self.environment, "hosts": self.hosts}
        return {name: list(value) for name, value in given.items() if value}

    def of_remote_agent(self) -> JailSettings:
        """No jail, since the operator starts a remote agent. Raises ConfigError when one is requested."""
        if self.mode == "open-network" or self.chosen():
            raise ConfigError(
                "--agent remote is not started by this command, so --jail and its options do not apply"
            )
        return JailSettings(mode="none")

    def check(self) -> None:
        """Raises ConfigError that names the wrong option, or what this machine lacks."""
        if self.mode not in get_args(Mode):
            raise ConfigError(f"--jail {self.mode!r}: there are {', '.join(get_args(Mode))}")
        for option, paths in (("--jail-bind", self.read), ("--jail-bind-rw", self.write)):
            for path in paths:
                _check_path(option, Path(path))
        for name in self.environment:
            if not _VARIABLE.fullmatch(name):
                raise ConfigError(
                    f"--jail-env {name!r} is not the name of a variable; give the name without a value"
                )
            if name not in os.environ:
                raise ConfigError(f"--jail-env {name}: the variable is not set; export it first")
        for text in self.hosts:
            host(text)
        if self.mode != "none":
            check_bubblewrap()


def host(text: str, option: str = "--allow-host") -> Host:
    """Parses `HOST` or `HOST:PORT` into lower-case name and port. ConfigError for anything else."""
    match = _HOST.fullmatch(text)
    port = HTTPS if match is None or match["port"] is None else int(match["port"])
    if match is None or not 0 < port < 1 << 16:
        raise ConfigError(f"{option} {text!r}: use the form HOST or HOST:PORT, without patterns")
    return match["name"].lower(), port


def check_bubblewrap() -> None:
    """Raises ConfigError, with the remedy, when this machine cannot build a jail."""
    filter_program()
    program = shutil.which("bwrap")
    if program is None:
        raise ConfigError(
            f"the agent's jail needs bubblewrap, which is not installed: {distribution.install('bubblewrap')};"
            f" {GIVE_UP}"
        )
    flags = ("--unshare-user", "--unshare-pid", "--unshare-net", "--unshare-ipc", "--unshare-uts")
    command = [program, *flags, "--ro-bind", "/", "/", "--proc", "/proc", "--dev", "/dev", "true"]
    why: object = None
    try:
        tried = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_TIMEOUT_S,
            check=False,
            start_new_session=True,  # else Ctrl-C would end it too, as on a machine that refuses
        )
        if tried.returncode:
            why = tried.stderr.decode("utf-8", "replace").strip() or f"exit status {tried.returncode}"
    except (OSError, subprocess.TimeoutExpired) as error:
        why = error
    if why is not None:
        remedy = f"permit user namespaces ({distribution.permit_namespaces()}), {GIVE_UP}"
        raise ConfigError(f"the agent's jail cannot be built here ({why}): {remedy}")


def absolute(path: str, started_in: Path) -> str:
    """An option's path, resolved relative to the folder in which the command was started."""
    return os.path.abspath(started_in / os.path.expanduser(path))


def _check_path(option: str, path: Path) -> None:
    if not path.exists():
        raise ConfigError(f"{option} {path}: no such file or folder")
    real = path.resolve()
    if real == Path("/"):
        raise ConfigError(f"{option} /: this would bind the whole machine; use --jail none instead")
    if STATE in real.parts or any(next(real.glob(pattern), None) for pattern in _STATE_FOLDERS):
        raise ConfigError(f"{option} {path}: it holds the credentials of a run that is open")


def without_proxy(urls: Mapping[str, str], known: Mapping[str, str]) -> dict[str, str]:
    """`NO_PROXY` and `no_proxy` with the hosts of the URLs, after the value in `known` variables."""
    value = known.get("no_proxy") or known.get("NO_PROXY") or ""
    hosts = dict.fromkeys(filter(None, (urlsplit(url).hostname for url in urls.values())))
    if value.strip() != "*":  # which programs understand alone
        value = ",".join(filter(None, (value, *hosts)))
    return dict.fromkeys(("NO_PROXY", "no_proxy"), value)
