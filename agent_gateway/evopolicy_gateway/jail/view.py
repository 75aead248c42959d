"""What a jailed program sees of this machine, as bubblewrap's arguments. Later ones lie over earlier ones.

As root the jail's processes are still root to the files that they see, though without any capability: so what root may
write by its name alone (`/proc/sys`) is read-only too. Of `/proc` there is what programs need. What the kernel counts there
for the whole machine, some of it for root only, is covered: hidden episodes move those numbers.
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
_PRIVATE = ("/etc/ssl/private", "/etc/pki/tls/private")
"""The machine's own keys, which root may read."""
_PROC_SHOWN = frozenset(("cpuinfo", "filesystems", "meminfo", "sys", "version"))
_PROC_COPIES = ("loadavg", "stat", "uptime")
"""Files with counters of the whole machine that programs cannot do without: they see them as they were, and empty."""
_COUNTERS = (
    *(f"/proc/sys/fs/{name}" for name in ("aio-nr", "dentry-state", "file-nr", "inode-nr", "inode-state")),
    *("/proc/sys/fs/quota", "/proc/sys/kernel/pty/nr"),
)


class View(msgspec.Struct, frozen=True, kw_only=True):
    """What one run's agent sees. Paths are absolute; those of this machine are seen at their own places."""

    workspace: Path
    private: Path
    """The agent's own folder outside the workspace: its home and /tmp."""
    home: str
    needs: Needs
    read: tuple[str, ...]
    """Chosen by the operator."""
    write: tuple[str, ...]
    hidden: tuple[Path, ...]
    """Never seen, also where it lies in something that is: the runs, the coordinator's state."""
    open_network: bool

    def prepare(self) -> None:
        """Makes the agent's home and /tmp; what is there stays, for an agent that goes on after its agent supervisor died."""
        for name in ("home", "tmp", "proc"):
            (self.private / name).mkdir(mode=0o700, parents=True, exist_ok=True)
        for name in _PROC_COPIES:
            content = Path("/proc", name).read_text()
            (self.private / "proc" / name).write_text(_without_counts(name, content))

    def arguments(self) -> list[str]:
        """The command up to the program."""
        command = [*_bubblewrap(), *([] if self.open_network else ["--unshare-net"])]
        command += [*_system(self.open_network), *self._proc()]
        command += [
            "--bind",
            str(self.private / "tmp"),
            "/tmp",
            "--dir",
            "/var",
            "--symlink",
            "../tmp",
            "/var/tmp",
        ]
        command += ["--bind", str(self.private / "home"), self.home]
        inside: list[str] = []
        outside: list[str] = []
        for path in (*self.needs.paths, *self.read, *self.write):
            (inside if self._is_hidden(path) else outside).append(path)
        command += self._binds(outside)
        for path, target in self.needs.links.items():
            if not any(_is_in(path, shown) for shown in outside) and not self._has_link(path, target):
                command += ["--symlink", target, path]
        for source, target in our_packages():
            command += ["--ro-bind", source, target]
        command += self._masks(outside)
        # Chosen by name among what is hidden, such as a policy of an earlier run.
        command += self._binds(inside)
        workspace = str(self.workspace)
        command += ["--bind", workspace, workspace]
        for name in ("feedback", "AGENTS.md"):
            if (self.workspace / name).exists():
                command += ["--ro-bind", f"{workspace}/{name}", f"{workspace}/{name}"]
        command += ["--ro-bind", str(Path(__file__).with_name("entry.py")), ENTRY]
        return [*command, "--remount-ro", "/", "--chdir", workspace]

    def _proc(self) -> list[str]:
        words = ["--proc", "/proc", "--dev", "/dev", "--ro-bind", "/proc/sys", "/proc/sys"]
        for path in _COUNTERS:
            words += _covered(path)
        for name in sorted(os.listdir("/proc")):
            path = f"/proc/{name}"
            if name in _PROC_COPIES:
                words += ["--ro-bind", str(self.private / "proc" / name), path]
            # Links lead to a process's own.
            elif not name.isdecimal() and name not in _PROC_SHOWN and not os.path.islink(path):
                words += _covered(path)
        return words

    def _has_link(self, path: str, target: str) -> bool:
        """Whether an earlier program of this agent left the link: its /tmp and home outlive each of its programs."""
        for shown, name in ((self.home, "home"), ("/tmp", "tmp")):
            if _is_in(path, shown):
                kept = self.private / name / os.path.relpath(path, shown)
                return kept.is_symlink() and os.readlink(kept) == target
        return False

    def _binds(self, paths: Sequence[str]) -> list[str]:
        """Parents before what lies in them; writable ones over read-only ones."""
        words: list[str] = []
        for path in sorted(
            dict.fromkeys(paths), key=lambda path: (path.count("/"), path in self.write, path)
        ):
            words += ["--bind" if path in self.write else "--ro-bind", path, path]
        return words

    def _masks(self, shown: Iterable[str]) -> list[str]:
        """Covers simulators, and what is hidden, in the folders that are shown."""
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

    def _is_hidden(self, path: str) -> bool:
        real = Path(os.path.realpath(path))
        return any(real.is_relative_to(secret) for secret in self.hidden)


def _bubblewrap() -> list[str]:
    program = shutil.which("bwrap") or "bwrap"
    command = [program, "--die-with-parent", "--new-session", "--cap-drop", "ALL", "--hostname", "agent"]
    command += ["--unshare-user", "--unshare-pid", "--unshare-ipc", "--unshare-uts", "--unshare-cgroup-try"]
    return [*command, *(["--disable-userns"] if _can_disable_userns(program) else [])]


@functools.cache
def _can_disable_userns(program: str) -> bool:
    """Since 0.8; older ones leave the kernel's own limits as they are."""
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
            words += ["--tmpfs", path]
    return words


def _covered(path: str) -> list[str]:
    """Nothing in place of what is there, if anything is."""
    if os.path.isdir(path):
        return ["--tmpfs", path]
    return ["--ro-bind", "/dev/null", path] if os.path.exists(path) else []


def _without_counts(name: str, content: str) -> str:
    """A file of `/proc` with zeros for what is counted."""
    if name == "loadavg":
        return "0.00 0.00 0.00 1/1 1\n"
    if name == "uptime":
        return f"{content.split()[0]} 0.00\n"
    lines = []
    for line in content.splitlines():
        key, *numbers = line.split()
        lines.append(line if key == "btime" else " ".join([key, *("0" for _ in numbers)]))
    return "\n".join(lines) + "\n"


def _is_in(path: str, folder: str) -> bool:
    return path == folder or path.startswith(folder + "/")
