"""Checks this machine: the rows of `evopolicy-worker doctor`, and of `evopolicy doctor`, which also checks
everything but the sandbox, and prints the functions that work without each missing part."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import platform
import resource
import shutil
import subprocess
import sys
import time
import timeit
from collections.abc import Callable, Iterable, Iterator
from ctypes.util import find_library
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import typer

from evopolicy_common.cli.frame import App
from evopolicy_common.console import filled_table, terminal
from evopolicy_common.errors import ConfigError
from evopolicy_common.installation import add_extra
from evopolicy_common.messages.episode import Tier
from evopolicy_common.processes import distribution, proc
from evopolicy_common.processes.preflight import EXTRAS, check_loopback, check_scratch
from evopolicy_common.terminal import say, say_json
from evopolicy_common.wire.credentials import local_state_dir
from evopolicy_worker.environments import accelerations
from evopolicy_worker.environments.browser import chromium
from evopolicy_worker.environments.interface import settings
from evopolicy_worker.environments.interface.fingerprint import fingerprint
from evopolicy_worker.environments.interface.gymnasium_adapter import quiet
from evopolicy_worker.sandbox import jail, seccomp
from evopolicy_worker.sandbox.inside.zygote import CLONE_NEWIPC, CLONE_NEWNS, CLONE_NEWPID, CLONE_NEWUSER
from evopolicy_worker.slots.slot import SANDBOXED, why_not

app = App(name="doctor")

Verdict = Literal["ok", "missing", "note"]
"""`missing` comes with a remedy; `note` is information."""

_NAMESPACES = {
    "user": CLONE_NEWUSER,
    "mount": CLONE_NEWNS,
    "pid": CLONE_NEWPID,
    "net": 0x40000000,
    "ipc": CLONE_NEWIPC,
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
_LEAST_FILES = 1024
_NEWEST_TRIED = 13
"""Python 3.13."""
_ROOMY_BYTES = 5 << 30
_PLAYS = {
    "coordinator": "nothing can be played or reported on here; workers can still join another machine's coordinator",
    "gateway": "no agent can be played here; `evopolicy try`, reports and workers work",
    "worker": "no episode can be played here; runs on another machine's workers, and reports, work",
}


class Check(msgspec.Struct, frozen=True):
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


def examine() -> Iterator[Check]:
    """All checks, in display order. The last ones start each sandbox tier, in about a second."""
    own, machine, landlock = fingerprint(), platform.machine(), jail.landlock_version()
    yield Check("kernel", "note", f"{platform.system()} {platform.release()} {machine}")
    boot_id = proc.boot_id()
    unknown = "unknown, so this worker gets no hidden episodes"
    yield row("boot id", boot_id, boot_id, unknown, proc.NO_BOOT_ID)
    version, why = _bubblewrap()
    yield row("bubblewrap", not why, version, why, distribution.install("bubblewrap"), _WITHOUT_NAMESPACES)
    for name, flag in _NAMESPACES.items():
        # An ordinary user can make the other namespaces only inside a user namespace.
        error = _tried(flag | (0 if os.geteuid() == 0 else CLONE_NEWUSER))
        advice = f"permit user namespaces: {distribution.permit_namespaces()}"
        missing = os.strerror(error)
        yield row(f"namespace {name}", not error, "can be made", missing, advice, _WITHOUT_NAMESPACES)
    yield row(
        "seccomp",
        seccomp.supported() and "Seccomp:" in Path("/proc/self/status").read_text(),
        f"filter for {machine}",
        f"no filter for {machine}, or a kernel without seccomp",
        "use an x86-64 or 64-bit ARM machine with CONFIG_SECCOMP_FILTER",
    )
    yield row(
        "Landlock",
        landlock,
        f"ABI {landlock}",
        "not in this kernel, or not enabled",
        "kernel 5.13 or later with lsm=landlock,…; tier bwrap works without it, tier landlock does not",
    )
    root = Path("/sys/fs/cgroup")
    if (root / "cgroup.controllers").is_file():
        version = f"version 2: {(root / 'cgroup.controllers').read_text().strip() or 'no controllers'}"
    else:
        version = "version 1" if root.is_dir() and any(root.iterdir()) else "none"
    yield Check("cgroups", "note", f"{version} (limits do not need them)")
    yield _pinning()
    memory = "not there (the runtime does not need it)"
    if Path("/dev/shm").is_dir():
        memory = f"{shutil.disk_usage('/dev/shm').free >> 20:,} MiB free (not shown to policies)"
    yield Check("/dev/shm", "note", memory)
    resolution = time.get_clock_info("monotonic").resolution
    source = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    name = source.read_text().strip() if source.is_file() else "unknown source"
    each = timeit.timeit(time.monotonic, number=1000) * 1e6
    yield Check("clock", "note", f"{name}, {resolution * 1e9:g} ns, {each:.0f} ns to read")
    yield Check("worker", "note", f"{own.code_version}, Python {own.python}")
    yield Check("packages", "note", ", ".join(f"{name} {version}" for name, version in own.packages.items()))
    yield Check("CPU", "note", own.cpu)
    yield _accelerations()
    for tier in SANDBOXED:
        why = why_not(tier) or ""
        advice = _UNMASK if "proc" in why and "mount" in why else "see the rows above"
        yield row(f"tier {tier}", not why, "a sandbox started", why, advice)
    yield Check("tier none", "note", "no sandbox; used only by runs that ask for it")


def best_tier(checks: Iterable[Check]) -> Tier | None:
    """The strongest tier that works; None when only `none` does."""
    working = {check.name for check in checks if check.verdict == "ok"}
    return next((tier for tier in SANDBOXED if f"tier {tier}" in working), None)


def _bubblewrap() -> tuple[str, str]:
    """Its version and path, or else why it is missing."""
    path = shutil.which("bwrap")
    if path is None:
        return "", "not on the PATH"
    try:
        done = subprocess.run(
            [path, "--version"], capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
        )
        return f"{done.stdout.strip()} ({path})", ""
    except (OSError, subprocess.TimeoutExpired) as error:
        return "", str(error)


def _tried(flags: int) -> int:
    """errno of unshare(flags) in a forked process; 0 on success."""
    libc = ctypes.CDLL(None, use_errno=True)
    child = os.fork()
    if child == 0:
        os._exit(ctypes.get_errno() & 0x7F if libc.unshare(flags) < 0 else 0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


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


@app.command("doctor", epilog="Example: evopolicy doctor")
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print the checks as JSON.")] = False,
) -> None:
    """Check this machine, and print the remedy for each missing part.

    Exit code 0 if runs can be played here in a sandbox, 1 if not.
    """
    no_worker = Check(
        "sandbox",
        "missing",
        f"this is {sys.platform}; the sandbox is made of Linux namespaces",
        without="coordinator, agents on another machine's workers, and reports",
        advice="use Linux or WSL2 for workers",
    )
    checks = [*examine_machine(), *(examine() if sys.platform == "linux" else (no_worker,))]
    tier = best_tier(checks)
    plays = tier is not None and not any(
        check.name.startswith("extra") and check.verdict == "missing" for check in checks
    )
    if as_json:
        say_json({"plays": plays, "tier": tier, "checks": checks})
    else:
        rows = [
            (each.name, each.verdict, each.found, "" if each.verdict == "ok" else each.without, each.advice)
            for each in checks
        ]
        terminal().print(filled_table(("check", "verdict", "found", "works without it", "remedy"), rows))
        if not plays:
            say("runs cannot be played here yet: see the rows that say missing")
        elif tier == "bwrap":
            say("next: evopolicy demo")
        else:
            say(
                "next: mend the row tier bwrap, which agents' jails need too; or give up the jail by name:"
                f" evopolicy local --env gym/continuouscar --agent evolve --tier {tier} --jail none"
            )
    raise typer.Exit(0 if plays else 1)


def examine_machine() -> Iterator[Check]:
    """The checks of everything but the sandbox, in display order. Starts no process."""
    version = platform.python_version()
    yield row(
        "Python",
        int(version.split(".")[1]) <= _NEWEST_TRIED,
        f"{version} ({sys.executable})",
        f"{version}; simulators are tried with 3.11 to 3.13",
        "use one of these where an environment does not install",
        otherwise="note",
    )
    for extra, lost in _PLAYS.items():
        modules = [module for module, its in EXTRAS.items() if its == extra]
        missing = [module for module in modules if importlib.util.find_spec(module) is None]
        absent = f"no module {', '.join(missing)}"
        yield row(f"extra {extra}", not missing, ", ".join(modules), absent, add_extra(extra), lost)
    library = find_library("EGL")
    lost = "everything but videos and replays of MuJoCo's environments"
    yield row("drawing (EGL)", library, str(library), "no libEGL", distribution.install("egl"), lost)
    lacking = chromium.lacking()
    yield row(
        "browser",
        not lacking,
        "" if lacking else chromium.program(),
        "no Chromium",
        lacking,
        "everything but environments that are web pages, and the tests of the report's pages",
        otherwise="note",
    )
    why = _fault_of(check_scratch)
    yield row(
        "temporary folder",
        not why,
        "can be written",
        why,
        "make room, or name another folder with TMPDIR",
        "nothing can be played here; reports work",
    )
    folder = local_state_dir()
    free = shutil.disk_usage(next(path for path in (folder, *folder.parents) if path.exists())).free
    free_space = f"{free / 2**30:.1f} GiB free for {folder}"
    yield row(
        "disk",
        free >= _ROOMY_BYTES,
        free_space,
        free_space,
        "make room, or name other folders with --state and --runs",
        "single runs; a sweep may fill it (`evopolicy disk` says how much it takes)",
        otherwise="note",
    )
    why = _fault_of(check_loopback)
    yield row(
        "ports",
        not why,
        "a port of 127.0.0.1 can be listened on",
        why.partition(";")[0],
        "bring IPv4 loopback up: ip link set lo up (in a container: give it a network)",
        "no agent can be played here; workers and reports work",
    )
    yield row(
        "date",
        # With a correct clock, no installed file is newer than the present.
        time.time() >= Path(__file__).stat().st_mtime,
        time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        f"{time.strftime('%Y-%m-%d', time.gmtime())}, before this program was installed",
        "set the clock: timedatectl set-ntp true",
        "one machine; certificates of other machines are refused when clocks differ by more than an hour",
    )
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    no_limit = soft == resource.RLIM_INFINITY
    known = "no limit" if no_limit else str(soft)
    most = "unlimited" if hard == resource.RLIM_INFINITY else str(min(hard, 65536))
    enough = no_limit or soft >= _LEAST_FILES
    advice = f"ulimit -n {most}"
    yield row("open files", enough, known, f"{known} at once", advice, "a few slots and runs at once")


def _fault_of(check: Callable[[], object]) -> str:
    """The ConfigError that a check raises, as text; empty if it passes."""
    try:
        check()
    except ConfigError as error:
        return str(error)
    return ""
