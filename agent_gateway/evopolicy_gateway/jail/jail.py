"""One run's jail, for the agent supervisor: a command, an environment, and network access for each program."""

from __future__ import annotations

import asyncio
import os
import socket
import sys
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from urllib.parse import urlsplit

import msgspec

from evopolicy_gateway.jail.installs import needs_of
from evopolicy_gateway.jail.proxy import JailProxy
from evopolicy_gateway.jail.settings import HTTPS, JailSettings, absolute, host, without_proxy
from evopolicy_gateway.jail.syscalls import filter_program
from evopolicy_gateway.jail.view import ENTRY, JailView

_PASSED = frozenset(
    (
        *("PATH", "USER", "LOGNAME", "SHELL", "LANG", "LANGUAGE", "TERM", "COLORTERM", "NO_COLOR", "TZ"),
        *("PYENV_ROOT", "PYENV_VERSION", "NVM_DIR"),
        *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"),
    )
)
_LOOPBACK_NAMES = ("localhost", "127.0.0.1")

HARNESS_HOSTS: Mapping[str, tuple[str, ...]] = {
    "codex": ("api.openai.com", "auth.openai.com", "chatgpt.com"),
    "claude-code": ("api.anthropic.com", "console.anthropic.com", "platform.claude.com"),
}
"""Hosts of the model, and of the login, of known harnesses."""
HARNESS_VARIABLES: Mapping[str, tuple[str, ...]] = {
    "codex": ("OPENAI_API_KEY", "CODEX_API_KEY", "OPENAI_BASE_URL"),
    "claude-code": (
        *("ANTHROPIC_API_KEY", "ANTHROPIC_AUTH_TOKEN", "ANTHROPIC_BASE_URL"),
        "CLAUDE_CODE_OAUTH_TOKEN",
    ),
}
"""Variables that hold the harness's key."""


class JailOrder(msgspec.Struct, frozen=True, kw_only=True):
    """The jail's settings, as an agent supervisor receives them."""

    settings: JailSettings
    private: str
    """Folder for the agent's home and /tmp, kept until the run ends."""
    hidden: tuple[str, ...] = ()
    """Folders that are never visible."""
    shown: str = ""
    """The workspace's path in the jail; empty: its own."""


class Way:
    """One start of a program: the complete command, and the socket through which it sends its listening sockets."""

    def __init__(
        self,
        jail: Sequence[str],
        program: Sequence[str],
        proxy: JailProxy | None,
        *,
        pids: int | None = None,
        fixed_cores: bool = False,
    ) -> None:
        """`proxy` None: the network is open. `pids`, `fixed_cores`: as for `Jail`."""
        self._proxy = proxy
        self._supervisor, child = socket.socketpair()
        self._serving: asyncio.Task[None] | None = None
        # By --args: the jail's first process shows its command line to the agent, and the arguments name hidden
        # folders.
        arguments = _readable(b"".join(os.fsencode(word) + b"\0" for word in jail[1:]))
        calls = _readable(filter_program(fixed_cores=fixed_cores))
        self.pass_fds = [arguments, calls]
        self.words = [*_PATIENT, jail[0], "--args", str(arguments), "--seccomp", str(calls)]
        python = os.path.realpath(getattr(sys, "_base_executable", sys.executable))
        self.words += ["--", python, "-I", "-S", ENTRY]
        if proxy is None:
            child.close()
            self.words += ["-", "-"]
        else:
            self.pass_fds.append(child.detach())
            self.words += [str(self.pass_fds[2]), ",".join(map(str, proxy.ports))]
        self.words += ["-" if pids is None else str(pids), *program]

    def started(self, ended: Callable[[], Awaitable[object]]) -> None:
        """Serves the program's network access until `ended` returns, which is when the program has ended."""
        self._close_files()
        if self._proxy is None:
            self._supervisor.close()
        else:
            self._serving = asyncio.create_task(self._serve(self._proxy, ended))

    def failed(self) -> None:
        """Releases the descriptors of a program that could not be started, or has ended."""
        self._close_files()
        self._supervisor.close()

    def _close_files(self) -> None:
        while self.pass_fds:
            os.close(self.pass_fds.pop())

    async def _serve(self, proxy: JailProxy, ended: Callable[[], Awaitable[object]]) -> None:
        serving = asyncio.ensure_future(proxy.serve(self._supervisor))
        try:
            await ended()
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            await proxy.close()
            self._supervisor.close()


def _readable(data: bytes) -> int:
    fd = os.memfd_create("evopolicy-jail")
    with open(fd, "wb", closefd=False) as file:
        file.write(data)
    os.lseek(fd, 0, os.SEEK_SET)
    return fd


# bubblewrap would end at once on SIGTERM and take the program with it; it ignores the signal, so the program gets it.
_PATIENT = ("/bin/sh", "-c", 'trap "" TERM INT; exec "$@"', "jail")


class Jail:
    """The jail of all programs of one agent; each start has namespaces of its own."""

    def __init__(
        self,
        order: JailOrder,
        *,
        harness: str,
        command: Sequence[str],
        workspace: Path,
        urls: Mapping[str, str],
        started_in: Path,
        variables: Sequence[str] = (),
        hosts: Sequence[str] = (),
        packages: Sequence[str] = (),
        inputs: Sequence[tuple[str, str]] = (),
        more_programs: Sequence[Sequence[str]] = (),
        pids: int | None = None,
        fixed_cores: bool = False,
    ) -> None:
        """`command`: words that the operator gave, never the agent's. `variables`, `hosts`: names that the agent's
        settings pass on and let it reach. `packages`: distributions of our Python that it imports. `inputs`: folders
        and files, each with its place in the jail, which starts with `~/` in the agent's home. `more_programs`: command
        lines of programs that the agent starts. `pids`: greatest number of processes, by a resource limit.
        `fixed_cores`: programs cannot change their affinity.

        `started_in`: folder to which the operator's paths are relative.
        """
        settings = order.settings
        self._open_network = settings.mode == "open-network"
        self._pids, self._fixed_cores = pids, fixed_cores
        self._variables = frozenset(
            (*_PASSED, *settings.environment, *variables, *HARNESS_VARIABLES.get(harness, ()))
        )
        home = os.path.expanduser("~")
        self._home = home if os.path.isabs(home) and home != "/" else "/home/agent"
        self._hosts = frozenset(map(host, (*HARNESS_HOSTS.get(harness, ()), *hosts, *settings.hosts)))
        ports = [*map(_port, urls.values()), *(port for name, port in self._hosts if name in _LOOPBACK_NAMES)]
        self._forwards = {port: ("127.0.0.1", port) for port in ports}
        self._view = JailView(
            workspace=workspace,
            shown=Path(order.shown) if order.shown else workspace,
            private=Path(order.private),
            home=self._home,
            needs=needs_of(command, os.environ.get("PATH"), more_programs),
            read=tuple(absolute(path, started_in) for path in settings.read),
            write=tuple(absolute(path, started_in) for path in settings.write),
            hidden=tuple(Path(path).resolve() for path in order.hidden),
            open_network=self._open_network,
            packages=tuple(packages),
            inputs=tuple(
                (source, os.path.join(self._home, target.removeprefix("~/"))) for source, target in inputs
            ),
        )
        self._view.prepare()
        self._proxy_port = self._proxy().proxy_port

    def environment(self, surroundings: Mapping[str, str], ours: Mapping[str, str]) -> dict[str, str]:
        """The agent's variables: the permitted ones of `surroundings`, `ours`, and the proxy for the allowed hosts."""
        passed = [name for name in surroundings if name in self._variables or name.startswith("LC_")]
        kept = {name: surroundings[name] for name in passed} | {"HOME": self._home, "TMPDIR": "/tmp", **ours}
        if self._open_network:
            return kept | without_proxy(ours, kept)
        proxy = f"http://127.0.0.1:{self._proxy_port}"
        here = ",".join(_LOOPBACK_NAMES)
        return kept | {
            **dict.fromkeys(("HTTPS_PROXY", "https_proxy"), proxy),
            **dict.fromkeys(("NO_PROXY", "no_proxy"), here),
            "NODE_USE_ENV_PROXY": "1",
        }

    def way(self, program: Sequence[str]) -> Way:
        proxy = None if self._open_network else self._proxy()
        words = self._view.arguments()
        return Way(words, program, proxy, pids=self._pids, fixed_cores=self._fixed_cores)

    def sealed(self, program: Sequence[str]) -> Way:
        """One start of a program without network access, such as a CLI that prints its version."""
        return Way(self._view.arguments(), program, None)

    def _proxy(self) -> JailProxy:
        return JailProxy(self._forwards, self._hosts)


def _port(url: str) -> int:
    parts = urlsplit(url)
    return parts.port or (HTTPS if parts.scheme == "https" else 80)
