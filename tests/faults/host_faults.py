"""What goes wrong with a host: its disk is full, its clock jumps, its cable is cut. For real, and for us alone.

In mount and network namespaces of our own (`enter_namespaces`) file systems and network devices are ours to break; the
clock is that of `set_clock.c`, which every process of a cluster is started with.
"""

from __future__ import annotations

import contextlib
import errno
import os
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

from machines import cgroups

from evopolicy_common.processes import proc

_INSIDE = "EVOPOLICY_FAULTS_INSIDE"


def enter_namespaces() -> None:
    """Starts this program again in mount and network namespaces of its own, with a loopback device; once."""
    if _INSIDE not in os.environ:
        os.environ[_INSIDE] = "1"
        as_root = [] if os.getuid() == 0 else ["--map-root-user"]
        os.execvp("unshare", ["unshare", *as_root, "--mount", "--net", sys.executable, *sys.argv])
    _ip("link", "set", "lo", "up")


@contextlib.contextmanager
def full_file_system(folder: Path) -> Iterator[None]:
    """Not a byte is free where `folder` is: whatever anyone writes there ends with ENOSPC."""
    ballast = folder / ".ballast"
    size = 1 << 20
    try:
        with ballast.open("wb", buffering=0) as file:
            while size:
                try:
                    file.write(bytes(size))
                except OSError as error:
                    if error.errno != errno.ENOSPC:
                        raise
                    size //= 2
        yield
    finally:
        ballast.unlink()


@contextlib.contextmanager
def read_only_mount(folder: Path) -> Iterator[None]:
    """Whatever is opened for writing below `folder` ends with EROFS. What is open already can be written: the kernel
    refuses to remount a file system with such files."""
    subprocess.run(["mount", "--bind", folder, folder], check=True)
    subprocess.run(["mount", "-o", "remount,bind,ro", folder], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


@contextlib.contextmanager
def out_of_memory(pid: int, timeout_s: float = 10.0) -> Iterator[bool]:
    """The process may take no more memory, so that the kernel kills it; False when it asked for none in that time."""
    with cgroups.limited(4096) as group:
        group.add(pid)
        try:
            deadline = time.monotonic() + timeout_s
            while _alive(pid) and time.monotonic() < deadline:
                time.sleep(0.02)
            yield not _alive(pid)
        finally:
            group.release()


def _alive(pid: int) -> bool:
    found = proc.stat(pid)
    return found is not None and found.state not in "ZX"


class Preloaded:
    """A library that all processes are started with, and the file by which it is told what to do."""

    def __init__(self, source: str, variable: str, folder: Path, n_bytes: int) -> None:
        name = source.removesuffix(".c")
        self._path = folder / name
        self._path.write_bytes(bytes(n_bytes))
        library = folder / f"{name}.so"
        program = Path(__file__).with_name(source)
        subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", library, program], check=True)
        self.environment = {"LD_PRELOAD": str(library), variable: str(self._path)}

    def _tell(self, data: bytes) -> None:
        with self._path.open("r+b", buffering=0) as file:
            file.write(data)


class Disks(Preloaded):
    """The disks below some folders, for all processes that are started with `environment`."""

    def __init__(self, folder: Path, folders: Sequence[Path]) -> None:
        super().__init__("bad_disk.c", "BAD_DISK", folder, 8 * len(folders))
        self._folders = list(folders)
        self.environment["BAD_DISK_FOLDERS"] = ":".join(map(str, folders))

    @contextlib.contextmanager
    def bad(self, folder: Path, error: int = 0, fsync_s: float = 0.0) -> Iterator[None]:
        """Whatever is changed there ends with this error, and each fsync takes so much longer."""
        states = [(error, round(1000 * fsync_s)) if each == folder else (0, 0) for each in self._folders]
        self._tell(b"".join(struct.pack("ii", *state) for state in states))
        try:
            yield
        finally:
            self._tell(bytes(8 * len(self._folders)))


class Clock(Preloaded):
    """The time of day of all processes that are started with `environment`; elapsed time is left alone, as the kernel
    leaves it when an operator or a time server sets the clock."""

    def __init__(self, folder: Path) -> None:
        super().__init__("set_clock.c", "SET_CLOCK", folder, 8)

    def jump(self, offset_s: int) -> None:
        """Sets the clock so many seconds off the true one, at once and for everyone."""
        self._tell(offset_s.to_bytes(8, sys.byteorder, signed=True))


class Cable:
    """A second host on this machine, a network namespace, and the cable to it: a pair of veth devices."""

    NEAR = "10.91.0.1"
    FAR = "10.91.0.2"

    def __init__(self) -> None:
        self.holder = subprocess.Popen(["unshare", "--net", "sleep", "infinity"])
        mine = os.readlink("/proc/self/ns/net")
        while os.readlink(f"/proc/{self.holder.pid}/ns/net") == mine:
            assert self.holder.poll() is None
        self.at_its_far_end = ["nsenter", "--net", "--target", str(self.holder.pid)]
        _ip("link", "add", "near0", "type", "veth", "peer", "name", "far0")
        _ip("link", "set", "far0", "netns", str(self.holder.pid))
        _ip("address", "add", f"{self.NEAR}/24", "dev", "near0")
        _ip("link", "set", "near0", "up")
        for words in (
            ["link", "set", "lo", "up"],
            ["address", "add", f"{self.FAR}/24", "dev", "far0"],
            ["link", "set", "far0", "up"],
        ):
            subprocess.run([*self.at_its_far_end, "ip", *words], check=True)

    @contextlib.contextmanager
    def cut(self) -> Iterator[None]:
        """The cable is out: packets vanish, and no connection is told."""
        _ip("link", "set", "near0", "down")
        try:
            yield
        finally:
            _ip("link", "set", "near0", "up")

    def far_end(self, state: Literal["up", "down"]) -> None:
        """The second host's side: while it is down, nobody answers there, and no connection is told."""
        subprocess.run([*self.at_its_far_end, "ip", "link", "set", "far0", state], check=True)

    @contextlib.contextmanager
    def slow(self) -> Iterator[None]:
        """32 kbit a second either way, packets that wait longer than half a second are dropped."""
        shape = ["root", "tbf", "rate", "32kbit", "burst", "3kb", "latency", "500ms"]
        far = [*self.at_its_far_end, "tc"]
        subprocess.run(["tc", "qdisc", "add", "dev", "near0", *shape], check=True)
        subprocess.run([*far, "qdisc", "add", "dev", "far0", *shape], check=True)
        try:
            yield
        finally:
            subprocess.run(["tc", "qdisc", "del", "dev", "near0", "root"], check=True)
            subprocess.run([*far, "qdisc", "del", "dev", "far0", "root"], check=True)

    def close(self) -> None:
        _ip("link", "del", "near0")
        self.holder.kill()
        self.holder.wait()


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)
