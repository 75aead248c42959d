"""The files that a jailed program sees, as bubblewrap's arguments. Later arguments cover earlier ones.

Run by root, the jail's processes are still root for the files that they see, though without any capability. So files
that root may write by user id alone (`/proc/sys`) are read-only too. `/proc` shows only what programs need: its
machine-wide counters, some readable by root only, are covered, because hidden episodes change them.
"""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec

from evopolicy_gateway.jail.installs import SYSTEM, Needs, hidden_below, our_packages

ENTRY = "/run/evopolicy/entry.py"

_ETC = (
    *("alternatives", "bash.bashrc", "ca-certificates", "ca-certificates.conf", "crypto-policies", "group"),
    *("host.conf", "hosts", "inputrc", "ld.so.cache", "ld.so.conf", "ld.so.conf.d", "locale.alias"),
    *("localtime", "magic", "mime.types", "nsswitch.conf", "os-release", "passwd", "pki", "profile"),
    *("protocols", "services", "ssl", "terminfo", "timezone"),
)
SHM_BYTES = 1 << 30
"""Size of the agent's shared memory."""
_COVER_BYTES = 1 << 20
"""Size of an empty folder that covers another; programs can write to it."""
_PRIVATE = ("/etc/ssl/private", "/etc/pki/tls/private")
"""The machine's own private keys, which root may read."""
_PROC_SHOWN = frozenset(("cpuinfo", "filesystems", "meminfo", "sys", "version"))
_PROC_COPIES = ("loadavg", "stat", "uptime")
"""Files with machine-wide counters that programs cannot do without: a copy with zeroed counters replaces them."""
_COUNTERS = (
    *(f"/proc/sys/fs/{name}" for name in ("aio-nr", "dentry-state", "file-nr", "inode-nr", "inode-state")),
    *("/proc/sys/fs/quota", "/proc/sys/kernel/pty/nr"),
)


class JailView(msgspec.Struct, frozen=True, kw_only=True):
    """The files that one run's agent sees. Paths are absolute; files of this machine appear at their own paths."""

    workspace: Path
    shown: Path | None = None
    """The workspace's path in the jail; None: its own."""
    private: Path
    """The agent's own folder outside the workspace: its home and /tmp."""
    home: str
    needs: Needs
    read: tuple[str, ...]
    """Paths that the operator added, read-only."""
    write: tuple[str, ...]
    hidden: tuple[Path, ...]
    """Never visible, even inside visible folders: the runs, the coordinator's state."""
    open_network: bool
    packages: tuple[str, ...] = ()
    """Distributions of our own Python, shown with what they require."""
    inputs: tuple[tuple[str, str], ...] = ()
    """Files and folders of the run that are shown read-only, each with its path in the jail."""

    def prepare(self) -> None:
        """Creates the agent's home and /tmp; existing ones stay, for an agent that resumes."""
        for name in ("home", "tmp", "proc"):
            (self.private / name).mkdir(mode=0o700, parents=True, exist_ok=True)
        for name in _PROC_COPIES:
            content = Path("/proc", name).read_text()
            (self.private / "proc" / name).write_text(_without_counts(name, content))

    def arguments(self) -> list[str]:
        """The bubblewrap command, up to the program."""
        command = [*_bubblewrap(), *([] if self.open_network else ["--unshare-net"])]
        command += [*_system(self.open_network), *self._proc()]
        command += ["--bind", str(self.private / "tmp"), "/tmp"]
        command += ["--dir", "/var", "--symlink", "../tmp", "/var/tmp"]
        command += ["--bind", str(self.private / "home"), self.home]
        paths = (*self.needs.paths, *self.read, *self.write)
        real = {path: Path(os.path.realpath(path)) for path in paths}
        inside = [path for path in paths if any(map(real[path].is_relative_to, self.hidden))]
        outside = [path for path in paths if path not in inside]
        command += self._binds(outside)
        for path, target in self.needs.links.items():
            if not any(_is_in(path, shown) for shown in outside):
                self._make_way(path)
                command += ["--symlink", target, path]
        for source, target in our_packages(self.packages):
            self._make_way(target)
            command += ["--ro-bind", source, target]
        command += self._masks(outside)
        # Paths that the operator named inside hidden folders, such as a policy of an earlier run.
        command += self._binds(inside)
        workspace = str(self.shown or self.workspace)
        self._make_way(workspace)
        command += ["--bind", str(self.workspace), workspace]
        for name in ("feedback", "AGENTS.md", "history"):
            # An agent may have a folder of that name of its own, which it may change.
            if (self.workspace / name / ("START.json" if name == "history" else "")).exists():
                command += ["--ro-bind", f"{self.workspace}/{name}", f"{workspace}/{name}"]
        for source, target in self.inputs:
            self._make_way(target)
            command += ["--ro-bind", source, target]
        command += ["--ro-bind", str(Path(__file__).with_name("entry.py")), ENTRY]
        return [*command, "--remount-ro", "/", "--chdir", workspace]

    def _proc(self) -> list[str]:
        words = ["--proc", "/proc", "--dev", "/dev", "--ro-bind", "/proc/sys", "/proc/sys"]
        words += ["--size", str(SHM_BYTES), "--tmpfs", "/dev/shm", "--remount-ro", "/dev"]
        for path in _COUNTERS:
            words += _covered(path)
        for name in sorted(os.listdir("/proc")):
            path = f"/proc/{name}"
            if name in _PROC_COPIES:
                words += ["--ro-bind", str(self.private / "proc" / name), path]
            # Links are not covered: they lead to a process's own files.
            elif not name.isdecimal() and name not in _PROC_SHOWN and not os.path.islink(path):
                words += _covered(path)
        return words

    def _make_way(self, path: str) -> None:
        """Removes links that an earlier program of the agent left in its home or /tmp on the way to a mount or link, or
        in its place: bubblewrap would follow them while it still sees the whole machine."""
        for shown, name in ((self.home, "home"), ("/tmp", "tmp")):
            if not _is_in(path, shown):
                continue
            place = self.private / name
            for part in Path(os.path.relpath(path, shown)).parts:
                place /= part
                if place.is_symlink():
                    place.unlink()

    def _binds(self, paths: Sequence[str]) -> list[str]:
        """Binds parents before their content, and writable paths over read-only ones."""
        words: list[str] = []
        for path in sorted(set(paths), key=lambda path: (path.count("/"), path in self.write, path)):
            self._make_way(path)
            words += ["--bind" if path in self.write else "--ro-bind", path, path]
        return words

    def _masks(self, shown: Iterable[str]) -> list[str]:
        """Covers simulators and hidden folders inside the visible folders."""
        covered: dict[str, None] = {}
        for folder in (*SYSTEM, *shown):
            if os.path.isdir(folder) and not (folder in SYSTEM and os.path.islink(folder)):
                covered |= dict.fromkeys(hidden_below(folder))
        for folder in shown:
            real = Path(os.path.realpath(folder))
            for secret in self.hidden:
                if secret.is_relative_to(real):
                    covered[os.path.join(folder, secret.relative_to(real))] = None
        return [word for path in covered for word in _covered(path)]


def _bubblewrap() -> list[str]:
    program = shutil.which("bwrap") or "bwrap"
    command = [program, "--die-with-parent", "--new-session", "--cap-drop", "ALL", "--hostname", "agent"]
    command += ["--unshare-user", "--unshare-pid", "--unshare-ipc", "--unshare-uts", "--unshare-cgroup-try"]
    return [*command, *(["--disable-userns"] if _can_disable_userns(program) else [])]


def confined(read: Sequence[Path], write: Sequence[Path]) -> list[str]:
    """The bubblewrap command for a process of ours with network; it sees the system, `read`, and `write`."""
    command = [*_bubblewrap(), *_system(True)]
    command += ["--proc", "/proc", "--dev", "/dev", "--tmpfs", "/tmp", "--clearenv"]
    for name in ("PATH", *_PROXY_VARIABLES, *map(str.lower, _PROXY_VARIABLES), *_CERTIFICATES):
        if name in os.environ:
            command += ["--setenv", name, os.environ[name]]
    files = [os.environ[name] for name in _CERTIFICATES if name in os.environ]
    for path in dict.fromkeys((*map(str, read), *files)):
        command += ["--ro-bind", path, path]
    for path in map(str, write):
        command += ["--bind", path, path]
    return [*command, "--remount-ro", "/", "--chdir", "/"]


_PROXY_VARIABLES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "NO_PROXY")
_CERTIFICATES = ("SSL_CERT_FILE", "SSL_CERT_DIR")


@functools.cache
def _can_disable_userns(program: str) -> bool:
    """Whether bubblewrap has the option (since 0.8); older versions leave the kernel's limits unchanged."""
    return b"--disable-userns" in subprocess.run([program, "--help"], capture_output=True, check=False).stdout


def _system(open_network: bool) -> list[str]:
    words: list[str] = []
    for path in SYSTEM:
        if os.path.islink(path):
            words += ["--symlink", os.readlink(path), path]
        elif os.path.isdir(path):
            words += ["--ro-bind", path, path]
    for name in (*_ETC, *(["resolv.conf"] if open_network else [])):
        words += ["--ro-bind-try", f"/etc/{name}", f"/etc/{name}"]
    for path in _PRIVATE:
        if os.path.isdir(path):
            words += _covered(path)
    return words


def _covered(path: str) -> list[str]:
    """Covers `path` with an empty folder or file, if it exists."""
    if os.path.isdir(path):
        return ["--size", str(_COVER_BYTES), "--tmpfs", path]
    return ["--ro-bind", "/dev/null", path] if os.path.exists(path) else []


def _without_counts(name: str, content: str) -> str:
    """A file of `/proc` with zeros in place of counters."""
    if name == "loadavg":
        return "0.00 0.00 0.00 1/1 1\n"
    if name == "uptime":
        return f"{content.split()[0]} 0.00\n"
    rows = [line.split() for line in content.splitlines()]
    zeroed = [row if row[0] == "btime" else [row[0], *("0" for _ in row[1:])] for row in rows]
    return "".join(" ".join(row) + "\n" for row in zeroed)


def _is_in(path: str, folder: str) -> bool:
    return path == folder or path.startswith(folder + "/")
