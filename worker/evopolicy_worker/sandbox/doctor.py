"""Checks what this machine provides for a worker's sandbox: the rows of `evopolicy-worker doctor`."""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import subprocess
import time
import timeit
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import msgspec

from evopolicy_common.messages.episode import Tier
from evopolicy_common.processes import distribution, host
from evopolicy_worker.environments import accelerations
from evopolicy_worker.environments.interface import settings
from evopolicy_worker.environments.interface.fingerprint import fingerprint
from evopolicy_worker.environments.interface.gymnasium_adapter import quiet
from evopolicy_worker.sandbox import SANDBOXED, jail, seccomp, why_not

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
_TIMEOUT_S = 10.0
_WITHOUT_NAMESPACES = (
    "policies with --tier landlock where the kernel has it, agents with --jail none; reports"
)
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


def row(
    name: str,
    ok: object,
    found: str,
    missing: str,
    advice: str,
    without: str = "",
    otherwise: Verdict = "missing",
) -> Check:
    """`found` if it is `ok`, else `missing` with the remedy."""
    if ok:
        return Check(name, "ok", found, without=without)
    return Check(name, otherwise, missing, advice, without)


def examine() -> tuple[Check, ...]:
    """All checks, in display order. Starts each sandbox tier once, which takes about a second."""
    own, machine, version = fingerprint(), platform.machine(), jail.landlock_version()
    filtered = seccomp.supported() and "Seccomp:" in Path("/proc/self/status").read_text()
    packages = ", ".join(f"{name} {version}" for name, version in own.packages.items())
    return (
        Check("kernel", "note", f"{platform.system()} {platform.release()} {machine}"),
        _boot_id(),
        _bubblewrap(),
        *(_namespace(name, flag) for name, flag in _NAMESPACES.items()),
        row(
            "seccomp",
            filtered,
            f"filter for {machine}",
            f"no filter for {machine}, or a kernel without seccomp",
            "use an x86-64 or 64-bit ARM machine with CONFIG_SECCOMP_FILTER",
        ),
        row(
            "Landlock",
            version,
            f"ABI {version}",
            "not in this kernel, or not enabled",
            "kernel 5.13 or later with lsm=landlock,…; tier bwrap works without it, tier landlock does not",
        ),
        _cgroups(),
        _pinning(),
        _shared_memory(),
        _clock(),
        Check("worker", "note", f"{own.code_version}, Python {own.python}"),
        Check("packages", "note", packages),
        Check("CPU", "note", own.cpu),
        _accelerations(),
        *map(_tier, SANDBOXED),
        Check("tier none", "note", "no sandbox; used only by runs that ask for it"),
    )


def best_tier(checks: Iterable[Check]) -> Tier | None:
    """The strongest tier that works; None when only `none` does."""
    working = {check.name for check in checks if check.verdict == "ok"}
    return next((tier for tier in SANDBOXED if f"tier {tier}" in working), None)


def _boot_id() -> Check:
    boot_id = host.boot_id()
    return row(
        "boot id", boot_id, boot_id, "unknown, so this worker gets no hidden episodes", advice=host.NO_BOOT_ID
    )


def _bubblewrap() -> Check:
    path, why, version = shutil.which("bwrap"), "not on the PATH", ""
    if path is not None:
        try:
            done = subprocess.run(
                [path, "--version"], capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
            )
            why, version = "", f"{done.stdout.strip()} ({path})"
        except (OSError, subprocess.TimeoutExpired) as error:
            why = str(error)
    return row("bubblewrap", not why, version, why, distribution.install("bubblewrap"), _WITHOUT_NAMESPACES)


def _namespace(name: str, flag: int) -> Check:
    # An ordinary user can make the other namespaces only inside a user namespace.
    error = _tried(flag | (0 if os.geteuid() == 0 else _NAMESPACES["user"]))
    return row(
        f"namespace {name}",
        error == 0,
        "can be made",
        os.strerror(error),
        f"permit user namespaces: {distribution.permit_namespaces()}",
        _WITHOUT_NAMESPACES,
    )


def _tried(flags: int) -> int:
    """errno of unshare(flags) in a forked process; 0 on success."""
    libc = ctypes.CDLL(None, use_errno=True)
    child = os.fork()
    if child == 0:
        os._exit(ctypes.get_errno() & 0x7F if libc.unshare(flags) < 0 else 0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _cgroups() -> Check:
    root = Path("/sys/fs/cgroup")
    if (root / "cgroup.controllers").is_file():
        version = f"version 2: {(root / 'cgroup.controllers').read_text().strip() or 'no controllers'}"
    else:
        version = "version 1" if root.is_dir() and any(root.iterdir()) else "none"
    return Check("cgroups", "note", f"{version} (limits do not need them)")


def _pinning() -> Check:
    allowed, why = os.sched_getaffinity(0), ""
    try:
        os.sched_setaffinity(0, {min(allowed)})
        os.sched_setaffinity(0, allowed)
    except OSError as error:
        why = error.strerror or str(error)
    cores = f"{len(allowed)} of {os.cpu_count()} cores may be used"
    advice = "allow sched_setaffinity; without it a step costs 100 µs more"
    return row("CPU pinning", not why, cores, why, advice)


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
    each = timeit.timeit(time.monotonic, number=1000) * 1e6
    return Check("clock", "note", f"{name}, {resolution * 1e9:g} ns, {each:.0f} ns to read")


def _accelerations() -> Check:
    if not settings.accelerations_on():
        return Check("accelerations", "note", "all off: EVOPOLICY_ACCELERATIONS is set")
    with quiet():
        off = accelerations.off()
    return row(
        "accelerations",
        not off,
        "all that the installed environments have are on",
        "; ".join(f"{name} off ({why})" for name, why in off.items()),
        "install the proved versions: -c constraints.txt",
        otherwise="note",
    )


def _tier(tier: Tier) -> Check:
    why = why_not(tier) or ""
    advice = _UNMASK if "proc" in why and "mount" in why else "see the rows above"
    return row(f"tier {tier}", not why, "a sandbox started", why, advice)
