"""Checks what this machine provides for a worker's sandbox: the rows of `evopolicy-worker doctor`."""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import subprocess
import time
from pathlib import Path
from typing import Literal

import msgspec

from evopolicy_common.messages.episode import Tier
from evopolicy_common.processes import distribution, host
from evopolicy_worker.environments import accelerations
from evopolicy_worker.environments.interface import settings
from evopolicy_worker.environments.interface.fingerprint import fingerprint
from evopolicy_worker.environments.interface.gymnasium_adapter import quiet
from evopolicy_worker.sandbox import jail, seccomp, why_not

Verdict = Literal["ok", "missing", "note"]
"""`missing` comes with a remedy; `note` is information."""

_NAMESPACES = {
    "user": 0x10000000,
    "mount": 0x00020000,
    "pid": 0x20000000,
    "net": 0x40000000,
    "ipc": 0x08000000,
    "uts": 0x04000000,
}
_CLONE_NEWUSER = 0x10000000
_TIMEOUT_S = 10.0
_UNMASK = (
    "a slot mounts a /proc of its own, which the kernel refuses while parts of this one are covered; in a container:"
    " --security-opt systempaths=unconfined"
)


class Check(msgspec.Struct, frozen=True):
    """The result of one check."""

    name: str
    verdict: Verdict
    found: str
    advice: str = ""
    """The remedy when something is missing."""
    without: str = ""
    """The functions that work without it."""


def examine(allowed_packages: tuple[str, ...] = ("numpy",)) -> tuple[Check, ...]:
    """All checks, in display order. Starts each sandbox tier once, which takes about a second."""
    return (
        _kernel(),
        _boot_id(),
        _bubblewrap(),
        *(_namespace(name, flag) for name, flag in _NAMESPACES.items()),
        _seccomp(),
        _landlock(),
        _cgroups(),
        _pinning(),
        _shared_memory(),
        _clock(),
        *_fingerprint(),
        _accelerations(),
        *_tiers(allowed_packages),
    )


def best_tier(checks: tuple[Check, ...]) -> Tier | None:
    """The strongest tier that works; None when only `none` does."""
    working = {check.name.removeprefix("tier ") for check in checks if check.verdict == "ok"}
    return "bwrap" if "bwrap" in working else "landlock" if "landlock" in working else None


def _kernel() -> Check:
    return Check("kernel", "note", f"{platform.system()} {platform.release()} {platform.machine()}")


def _boot_id() -> Check:
    boot_id = host.boot_id()
    if boot_id:
        return Check("boot id", "ok", boot_id)
    return Check(
        "boot id", "missing", "unknown, so this worker gets no hidden episodes", advice=host.NO_BOOT_ID
    )


def _bubblewrap() -> Check:
    path = shutil.which("bwrap")
    if path is None:
        return _no_bubblewrap("not on the PATH")
    try:
        output = subprocess.run(
            [path, "--version"], capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
        ).stdout.strip()
    except (OSError, subprocess.TimeoutExpired) as error:
        return _no_bubblewrap(str(error))
    return Check("bubblewrap", "ok", f"{output} ({path})")


def _no_bubblewrap(found: str) -> Check:
    return Check(
        "bubblewrap",
        "missing",
        found,
        advice=distribution.install("bubblewrap"),
        without="policies with --tier landlock where the kernel has it, agents with --jail none; reports",
    )


def _namespace(name: str, flag: int) -> Check:
    # An ordinary user can make the other namespaces only inside a user namespace.
    flags = flag | (0 if os.geteuid() == 0 else _CLONE_NEWUSER)
    error = _tried(flags)
    if error == 0:
        return Check(f"namespace {name}", "ok", "can be made")
    return Check(
        f"namespace {name}",
        "missing",
        os.strerror(error),
        advice=f"permit user namespaces: {distribution.permit_namespaces()}",
        without="policies with --tier landlock where the kernel has it, agents with --jail none; reports",
    )


def _tried(flags: int) -> int:
    """errno of unshare(flags) in a forked process; 0 on success."""
    libc = ctypes.CDLL(None, use_errno=True)
    child = os.fork()
    if child == 0:
        os._exit(ctypes.get_errno() & 0x7F if libc.unshare(flags) < 0 else 0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _seccomp() -> Check:
    if seccomp.supported() and "Seccomp:" in Path("/proc/self/status").read_text():
        return Check("seccomp", "ok", f"filter for {platform.machine()}")
    return Check(
        "seccomp",
        "missing",
        f"no filter for {platform.machine()}, or a kernel without seccomp",
        advice="use an x86-64 or 64-bit ARM machine with CONFIG_SECCOMP_FILTER",
    )


def _landlock() -> Check:
    version = jail.landlock_version()
    if version:
        return Check("Landlock", "ok", f"ABI {version}")
    return Check(
        "Landlock",
        "missing",
        "not in this kernel, or not enabled",
        advice="kernel 5.13 or later with lsm=landlock,…; tier bwrap works without it, tier landlock does not",
    )


def _cgroups() -> Check:
    root = Path("/sys/fs/cgroup")
    if (root / "cgroup.controllers").is_file():
        version = f"version 2: {(root / 'cgroup.controllers').read_text().strip() or 'no controllers'}"
    elif root.is_dir() and any(root.iterdir()):
        version = "version 1"
    else:
        version = "none"
    return Check("cgroups", "note", f"{version} (limits do not need them)")


def _pinning() -> Check:
    allowed = os.sched_getaffinity(0)
    core = min(allowed)
    try:
        os.sched_setaffinity(0, {core})
        os.sched_setaffinity(0, allowed)
    except OSError as error:
        return Check(
            "CPU pinning",
            "missing",
            error.strerror or str(error),
            advice="allow sched_setaffinity; without it a step costs 100 µs more",
        )
    return Check("CPU pinning", "ok", f"{len(allowed)} of {os.cpu_count()} cores may be used")


def _shared_memory() -> Check:
    path = Path("/dev/shm")
    if not path.is_dir():
        return Check("/dev/shm", "note", "not there (the runtime does not need it)")
    free = shutil.disk_usage(path).free
    return Check("/dev/shm", "note", f"{free >> 20:,} MiB free (not shown to policies)")


def _clock() -> Check:
    resolution = time.get_clock_info("monotonic").resolution
    source = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    name = source.read_text().strip() if source.is_file() else "unknown source"
    start = time.perf_counter()
    for _ in range(1000):
        time.monotonic()
    each = (time.perf_counter() - start) * 1e6
    return Check("clock", "note", f"{name}, {resolution * 1e9:g} ns, {each:.0f} ns to read")


def _fingerprint() -> list[Check]:
    own = fingerprint()
    packages = ", ".join(f"{name} {version}" for name, version in own.packages.items())
    return [
        Check("worker", "note", f"{own.code_version}, Python {own.python}"),
        Check("packages", "note", packages),
        Check("CPU", "note", own.cpu),
    ]


def _accelerations() -> Check:
    if not settings.accelerations_on():
        return Check("accelerations", "note", "all off: EVOPOLICY_ACCELERATIONS is set")
    with quiet():
        off = accelerations.off()
    texts = [f"{name} off ({why})" for name, why in off.items()]
    return Check(
        "accelerations",
        "note" if off else "ok",
        "; ".join(texts) or "all that the installed environments have are on",
        advice="install the proved versions: -c constraints.txt" if off else "",
    )


def _tiers(allowed_packages: tuple[str, ...]) -> list[Check]:
    rows = []
    tiers: tuple[Tier, ...] = ("bwrap", "landlock")
    for tier in tiers:
        why = why_not(tier, allowed_packages)
        if why is None:
            rows.append(Check(f"tier {tier}", "ok", "a sandbox started"))
        else:
            advice = _UNMASK if "proc" in why and "mount" in why else "see the rows above"
            rows.append(Check(f"tier {tier}", "missing", why, advice=advice))
    return [
        *rows,
        Check("tier none", "note", "no sandbox; used only by runs that ask for it"),
    ]
