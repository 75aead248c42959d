"""Checks what this machine provides, apart from the sandbox: rows of `evopolicy doctor`."""

from __future__ import annotations

import importlib.util
import platform
import resource
import shutil
import sys
import time
from ctypes.util import find_library
from pathlib import Path

from evopolicy_common.errors import ConfigError
from evopolicy_common.installation import add_extra
from evopolicy_common.processes import distribution
from evopolicy_common.processes.preflight import EXTRAS, check_loopback, check_scratch
from evopolicy_common.wire.credentials import local_state_dir
from evopolicy_worker.environments.browser import chromium
from evopolicy_worker.sandbox.doctor import Check

_LEAST_FILES = 1024
_NEWEST_TRIED = 13
"""Python 3.13."""
_ROOMY_BYTES = 5 << 30
_PLAYS = {
    "coordinator": "nothing can be played or reported on here; workers can still join another machine's coordinator",
    "gateway": "no agent can be played here; `evopolicy try`, reports and workers work",
    "worker": "no episode can be played here; runs on another machine's workers, and reports, work",
}


def examine_machine() -> tuple[Check, ...]:
    """All checks, in display order. Starts no process."""
    return (_python(), *_extras(), _graphics(), _browser(), _scratch(), _disk(), _ports(), _date(), _files())


def _python() -> Check:
    version = platform.python_version()
    if int(version.split(".")[1]) <= _NEWEST_TRIED:
        return Check("Python", "ok", f"{version} ({sys.executable})")
    return Check(
        "Python",
        "note",
        f"{version}; simulators are tried with 3.11 to 3.13",
        advice="use one of these where an environment does not install",
    )


def _extras() -> list[Check]:
    rows = []
    for extra, lost in _PLAYS.items():
        modules = [module for module, its in EXTRAS.items() if its == extra]
        missing = [module for module in modules if importlib.util.find_spec(module) is None]
        rows.append(
            Check(
                f"extra {extra}",
                "missing" if missing else "ok",
                f"no module {', '.join(missing)}" if missing else ", ".join(modules),
                without=lost,
                advice=add_extra(extra) if missing else "",
            )
        )
    return rows


def _graphics() -> Check:
    library = find_library("EGL")
    return Check(
        "drawing (EGL)",
        "missing" if library is None else "ok",
        library or "no libEGL",
        without="everything but videos and replays of MuJoCo's environments",
        advice="" if library else distribution.install("egl"),
    )


def _browser() -> Check:
    lacking = chromium.lacking()
    return Check(
        "browser",
        "note" if lacking else "ok",
        "no Chromium" if lacking else chromium.program(),
        without="everything but environments that are web pages, and the tests of the report's pages",
        advice=lacking,
    )


def _scratch() -> Check:
    try:
        check_scratch()
    except ConfigError as error:
        return Check(
            "temporary folder",
            "missing",
            str(error),
            without="nothing can be played here; reports work",
            advice="make room, or name another folder with TMPDIR",
        )
    return Check("temporary folder", "ok", "can be written")


def _disk() -> Check:
    folder = local_state_dir()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(there).free
    free_space = f"{free / 2**30:.1f} GiB free for {folder}"
    if free >= _ROOMY_BYTES:
        return Check("disk", "ok", free_space)
    return Check(
        "disk",
        "note",
        free_space,
        without="single runs; a sweep may fill it (`evopolicy disk` says how much it takes)",
        advice="make room, or name other folders with --state and --runs",
    )


def _ports() -> Check:
    try:
        check_loopback()
    except ConfigError as error:
        return Check(
            "ports",
            "missing",
            str(error).partition(";")[0],
            without="no agent can be played here; workers and reports work",
            advice="bring IPv4 loopback up: ip link set lo up (in a container: give it a network)",
        )
    return Check("ports", "ok", "a port of 127.0.0.1 can be listened on")


def _date() -> Check:
    # With a correct clock, no installed file is newer than the present.
    newest = Path(__file__).stat().st_mtime
    if time.time() >= newest:
        return Check("date", "ok", time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()))
    return Check(
        "date",
        "missing",
        f"{time.strftime('%Y-%m-%d', time.gmtime())}, before this program was installed",
        without="one machine; certificates of other machines are refused when clocks differ by more than an hour",
        advice="set the clock: timedatectl set-ntp true",
    )


def _files() -> Check:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    known = str(soft) if soft != resource.RLIM_INFINITY else "no limit"
    if soft == resource.RLIM_INFINITY or soft >= _LEAST_FILES:
        return Check("open files", "ok", known)
    most = "unlimited" if hard == resource.RLIM_INFINITY else str(min(hard, 65536))
    return Check(
        "open files",
        "missing",
        f"{known} at once",
        without="a few slots and runs at once",
        advice=f"ulimit -n {most}",
    )
