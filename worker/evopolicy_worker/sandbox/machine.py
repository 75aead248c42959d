"""Checks what this machine provides, apart from the sandbox: rows of `evopolicy doctor`."""

from __future__ import annotations

import importlib.util
import platform
import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from ctypes.util import find_library
from pathlib import Path

from evopolicy_common.errors import ConfigError
from evopolicy_common.installation import add_extra
from evopolicy_common.processes import distribution
from evopolicy_common.processes.preflight import EXTRAS, check_loopback, check_scratch
from evopolicy_common.wire.credentials import local_state_dir
from evopolicy_worker.environments.browser import chromium
from evopolicy_worker.sandbox.doctor import Check, row

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
    return row(
        "Python",
        int(version.split(".")[1]) <= _NEWEST_TRIED,
        f"{version} ({sys.executable})",
        f"{version}; simulators are tried with 3.11 to 3.13",
        "use one of these where an environment does not install",
        otherwise="note",
    )


def _extras() -> Iterator[Check]:
    for extra, lost in _PLAYS.items():
        modules = [module for module, its in EXTRAS.items() if its == extra]
        missing = [module for module in modules if importlib.util.find_spec(module) is None]
        absent = f"no module {', '.join(missing)}"
        yield row(f"extra {extra}", not missing, ", ".join(modules), absent, add_extra(extra), lost)


def _graphics() -> Check:
    library = find_library("EGL")
    return row(
        "drawing (EGL)",
        library,
        str(library),
        "no libEGL",
        distribution.install("egl"),
        "everything but videos and replays of MuJoCo's environments",
    )


def _browser() -> Check:
    lacking = chromium.lacking()
    return row(
        "browser",
        not lacking,
        "" if lacking else chromium.program(),
        "no Chromium",
        lacking,
        "everything but environments that are web pages, and the tests of the report's pages",
        otherwise="note",
    )


def _fault_of(check: Callable[[], object]) -> str:
    """The ConfigError that a check raises, as text; empty if it passes."""
    try:
        check()
    except ConfigError as error:
        return str(error)
    return ""


def _scratch() -> Check:
    why = _fault_of(check_scratch)
    advice = "make room, or name another folder with TMPDIR"
    without = "nothing can be played here; reports work"
    return row("temporary folder", not why, "can be written", why, advice, without)


def _disk() -> Check:
    folder = local_state_dir()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(there).free
    free_space = f"{free / 2**30:.1f} GiB free for {folder}"
    return row(
        "disk",
        free >= _ROOMY_BYTES,
        free_space,
        free_space,
        "make room, or name other folders with --state and --runs",
        "single runs; a sweep may fill it (`evopolicy disk` says how much it takes)",
        otherwise="note",
    )


def _ports() -> Check:
    why = _fault_of(check_loopback)
    return row(
        "ports",
        not why,
        "a port of 127.0.0.1 can be listened on",
        why.partition(";")[0],
        "bring IPv4 loopback up: ip link set lo up (in a container: give it a network)",
        "no agent can be played here; workers and reports work",
    )


def _date() -> Check:
    # With a correct clock, no installed file is newer than the present.
    return row(
        "date",
        time.time() >= Path(__file__).stat().st_mtime,
        time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        f"{time.strftime('%Y-%m-%d', time.gmtime())}, before this program was installed",
        "set the clock: timedatectl set-ntp true",
        "one machine; certificates of other machines are refused when clocks differ by more than an hour",
    )


def _files() -> Check:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    no_limit = soft == resource.RLIM_INFINITY
    known = "no limit" if no_limit else str(soft)
    most = "unlimited" if hard == resource.RLIM_INFINITY else str(min(hard, 65536))
    enough = no_limit or soft >= _LEAST_FILES
    without = "a few slots and runs at once"
    return row("open files", enough, known, f"{known} at once", f"ulimit -n {most}", without)
