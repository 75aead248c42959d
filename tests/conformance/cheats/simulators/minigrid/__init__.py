"""A simulator that somebody else wrote: as it is imported, it reads, writes and reaches for what is not its own.

Its targets are in `TARGETS.json` beside it. What came of each attempt is the message of the error with which its import
ends: "got …" where the attempt succeeded, the refusal where it did not.
"""

import ctypes
import json
import os
import platform
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

T: dict[str, Any] = json.loads(Path(__file__).with_name("TARGETS.json").read_text())
libc = ctypes.CDLL(None, use_errno=True)
ARM = platform.machine() == "aarch64"


def check(result: int) -> int:
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result


def tcp() -> str:
    with socket.create_connection(("127.0.0.1", T["port"]), 5) as link:
        return link.recv(100).decode()


def unix(address: str) -> str:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
        link.connect(address)
        return link.recv(100).decode()


def written(path: str) -> str:
    with open(path, "w") as file:
        file.write("from a simulator")
    return path


def read_memory() -> str:
    buffer = ctypes.create_string_buffer(8)
    local = struct.pack("<QQ", ctypes.addressof(buffer), 8)
    remote = struct.pack("<QQ", T["address"], 8)
    # The last argument is passed in memory, of which ctypes sets 32 bits for an int.
    check(libc.syscall(270 if ARM else 310, T["supervisor"], local, 1, remote, 1, ctypes.c_ulong(0)))
    return buffer.raw.decode()


def prlimit() -> str:
    old = ctypes.create_string_buffer(16)
    check(libc.prlimit(T["supervisor"], 7, None, old))
    return old.raw.hex()


def in_a_child() -> str:
    """What it starts is held to the same."""
    program = "import sys; print(open(sys.argv[1]).read())"
    return subprocess.run(
        [sys.executable, "-c", program, T["credentials"]], capture_output=True, text=True, check=True
    ).stdout


def variables() -> str:
    found = [name for name in os.environ if "SECRET" in name]
    if not found:
        raise LookupError("no such variable")
    return os.environ[found[0]]


def signalled() -> str:
    os.kill(T["supervisor"], signal.SIGURG)
    return "sent"


def all_signalled() -> str:
    """As a shell's `kill -- -1`; to itself and those below it, it may."""
    os.kill(-T["group"], signal.SIGURG)
    return "sent"


def pidfd() -> str:
    fd = os.pidfd_open(T["supervisor"])
    signal.pidfd_send_signal(fd, signal.SIGURG)
    return "sent"


def keyring() -> str:
    """The session keyring of the login, which a later run would find."""
    return str(check(libc.syscall(219 if ARM else 250, 0, -3, 0)))


def namespaces() -> str:
    check(libc.unshare(0x10000000))
    return "a user namespace"


def remount() -> str:
    check(libc.mount(None, os.path.dirname(os.__file__).encode(), None, 0x1000 | 32, None))
    return "remounted"


ATTEMPTS: dict[str, Callable[[], Any]] = {
    "reads the worker's credentials": lambda: Path(T["credentials"]).read_text(),
    "starts a program that reads them": in_a_child,
    "lists the state folder": lambda: os.listdir(T["state"]),
    "lists the operator's home": lambda: os.listdir(T["home"]),
    "reads the supervisor's variables": variables,
    "reads the supervisor's variables in /proc": lambda: (
        Path(f"/proc/{T['supervisor']}/environ").read_bytes().hex()
    ),
    "reads the supervisor's memory in /proc": lambda: os.open(f"/proc/{T['supervisor']}/mem", os.O_RDONLY),
    "goes through the supervisor's root folder": lambda: os.listdir(
        f"/proc/{T['supervisor']}/root{T['state']}"
    ),
    "sees what the supervisor has open": lambda: os.readlink(f"/proc/{T['supervisor']}/fd/0"),
    "reads the supervisor's memory": read_memory,
    "reads the supervisor's limits": prlimit,
    "signals the supervisor": signalled,
    "signals the supervisor's group": all_signalled,
    "signals the supervisor by a descriptor": pidfd,
    "traces the supervisor": lambda: check(libc.ptrace(0x4206, T["supervisor"], 0, 0)),
    "connects to a port of this machine": tcp,
    "connects to the coordinator's socket": lambda: unix(T["socket"]),
    "connects to an abstract socket": lambda: unix("\0" + T["abstract"]),
    "writes into site-packages": lambda: written(f"{T['site']}/evopolicy_planted.py"),
    "writes into the standard library": lambda: written(
        f"{os.path.dirname(os.__file__)}/evopolicy_planted.py"
    ),
    "writes into the worker's code": lambda: written(f"{T['worker_code']}/evopolicy_planted.py"),
    "writes into its own folder": lambda: written(str(Path(__file__).with_name("planted.py"))),
    "reads another slot's scratch folder": lambda: Path(T["other_scratch"]).read_text(),
    "writes into another slot's scratch folder": lambda: written(T["other_scratch"]),
    "reads bundles that wait for other slots": lambda: os.listdir(T["bundles"]),
    "reads the session keyring": keyring,
    "makes a namespace": namespaces,
    "mounts": remount,
}
ALLOWED: dict[str, Callable[[], Any]] = {
    "writes into its scratch folder": lambda: written("here"),
    "writes into a temporary folder": lambda: written(f"{os.environ['TMPDIR']}/here"),
    "starts a program": lambda: subprocess.run(
        [sys.executable, "-c", "print(6 * 7)"], capture_output=True, check=True
    ),
}


def tried(attempt: Callable[[], Any]) -> str:
    try:
        return f"got {attempt()!r}"[:300]
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def leaves() -> None:
    for path in (f"/dev/shm/{T['left']}", f"/tmp/{T['left']}"):
        tried(lambda path=path: written(path))  # type: ignore[misc]


leaves()
raise RuntimeError(json.dumps({name: tried(attempt) for name, attempt in {**ATTEMPTS, **ALLOWED}.items()}))
