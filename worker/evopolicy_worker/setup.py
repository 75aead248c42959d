"""`evopolicy-worker setup FAMILY…`: a virtual environment of its own for families of environments.

pip installs this version of evopolicy there with the families' extras, in the versions of `constraints.txt` and the
families' pins. At the end one environment of each family is played in it for a few steps.
"""

from __future__ import annotations

import contextlib
import fcntl
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated
from urllib.parse import unquote, urlsplit

import msgspec
import typer

import evopolicy_common
from evopolicy_common import catalogue
from evopolicy_common.catalogue import installs
from evopolicy_common.catalogue.installs import Install, MadeEnvironment
from evopolicy_common.cli.conventions import fail_on_our_errors
from evopolicy_common.errors import ConfigError, MachineError
from evopolicy_common.installation import source
from evopolicy_common.processes.packages import canonical
from evopolicy_common.processes.parent_death import ending_with_parent
from evopolicy_common.processes.preflight import check_writable
from evopolicy_common.terminal import one_line, say
from evopolicy_worker.environments.browser import chromium
from evopolicy_worker.environments.checks.conformance import CheckResult

_PIP = ("-m", "pip", "--disable-pip-version-check", "--no-input", "install", "--quiet")
_TRIAL_STEPS = 5


def command(
    family: Annotated[list[str], typer.Argument(help="Families to install, such as atari.")],
) -> None:
    """Install families of environments, in tested versions, into a virtual environment of their own.

    Example: evopolicy-worker setup mo_gymnasium

    For families whose packages conflict with those installed here. Local commands start a worker from it.
    EVOPOLICY_INSTALLS names another folder.
    """
    with fail_on_our_errors(), contextlib.ExitStack() as stack:
        wanted = _wanted(family)
        folder = installs.root() / "+".join(wanted)
        check_writable(folder.parent, installs.FOLDER_VARIABLE)
        folder.parent.mkdir(parents=True, exist_ok=True)
        lock = stack.enter_context((folder.parent / f".{folder.name}.lock").open("w"))
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(f"another setup is installing into {folder}: wait until it has ended") from None
        _make(wanted, folder)
        worker = folder / "bin" / "evopolicy-worker"
        say(f"installed {', '.join(wanted)} in {folder}")
        say("local commands start a worker from it by themselves; to join another cluster:")
        say(f"next: {worker} {' '.join(f'--env {each}' for each in wanted)} --connect … --credentials …")


def _wanted(names: Sequence[str]) -> dict[str, Install]:
    known = installs.installs()
    for name in names:
        if name not in known:
            needed: set[str] = set()
            with contextlib.suppress(ConfigError):
                needed = {installs.family_of(each) for each in catalogue.resolve([name])} - {""}
            of_its_environments = f"; its environments need {' '.join(sorted(needed))}" if needed else ""
            raise ConfigError(
                f"no family {name!r} to install{of_its_environments}; families are {', '.join(known)}"
            )
    wanted = {name: known[name] for name in dict.fromkeys(names)}
    for name, each in wanted.items():
        if each.pins and len(wanted) > 1:
            alone = installs.setup_line(name)
            raise ConfigError(f"{name} excludes packages of other families: set it up alone, with `{alone}`")
        if not each.fits:
            raise ConfigError(
                f"{name} is tested with Python {each.python[0]} up to, but not including, {each.python[1]}: install"
                " evopolicy with such a Python, and run setup there"
            )
        if each.browser and (lacking := chromium.lacking()):
            raise MachineError(f"missing: {lacking}; then set the family up again")
    return wanted


def _make(wanted: Mapping[str, Install], folder: Path) -> None:
    """Makes the virtual environment in `folder`, in place of an earlier one. Raises ConfigError or MachineError."""
    needed = max(each.megabytes for each in wanted.values()) + 60 * len(wanted)
    check_writable(folder, installs.FOLDER_VARIABLE, least_bytes=needed << 20)
    made = MadeEnvironment(families=tuple(wanted), version=evopolicy_common.__version__)
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    mark = folder / installs.MARK
    mark.write_bytes(msgspec.json.format(msgspec.json.encode(made)))
    say(f"installing into {folder}: a minute or more, about {needed} MB", err=True)
    _run([sys.executable, "-m", "venv", str(folder)], "the virtual environment")
    own = msgspec.structs.replace(made, folder=str(folder))
    with tempfile.NamedTemporaryFile("w", prefix="evopolicy-setup-", suffix=".txt") as pins:
        pins.write(constraints(wanted))
        pins.flush()
        ours = requirement(",".join(each.extra for each in wanted.values()))
        _run([own.python, *_PIP, "--constraint", pins.name, *ours], ", ".join(wanted))
    if apart := installs.apart(wanted):
        _run([own.python, *_PIP, "--no-deps", *apart], ", ".join(apart))
    for name in wanted:
        _try(own, name)
    mark.write_bytes(msgspec.json.format(msgspec.json.encode(msgspec.structs.replace(made, ready=True))))


def requirement(extras: str) -> list[str]:
    """pip's words for this very installation: the clone or the wheel that it was made of."""
    url, is_folder = source()
    if is_folder:
        return ["--editable", f"{unquote(urlsplit(url).path)}[{extras}]"]
    return [f"evopolicy[{extras}] @ {url}"]


def constraints(wanted: Mapping[str, Install]) -> str:
    """Lines for pip: those of `constraints.txt`, with the families' pins in place of their own."""
    pins = {
        canonical(name): f"{name}=={version}"
        for each in wanted.values()
        for name, version in each.pins.items()
    }
    package = Path(evopolicy_common.__file__).parent
    # In a wheel it is among the shipped files, in a checkout at its top.
    places = (package.parent / "evopolicy_gateway", package.parents[1])
    usual = next((file for each in places if (file := each / "constraints.txt").is_file()), None)
    if usual is None:
        raise ConfigError("constraints.txt is missing from this installation: install evopolicy again")
    lines = usual.read_text("utf-8").splitlines()
    kept = [line for line in lines if canonical(re.split(r"[=;]", line)[0].strip()) not in pins]
    return "\n".join([*kept, *pins.values()]) + "\n"


def _run(program: Sequence[str], part: str) -> None:
    # pip ends with this process: otherwise it would go on to write into a folder that is made again.
    done = subprocess.run(
        ending_with_parent(program), capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL
    )
    if done.returncode:
        raise MachineError(f"{part} cannot be installed: {last_line(done.stderr + done.stdout)}")


def last_line(output: str) -> str:
    """The last line of a program's output that says something, errors first."""
    lines = list(filter(None, map(str.strip, output.splitlines())))
    errors = [line for line in lines if line.startswith("ERROR:")]
    errors = errors or [line for line in lines if "error" in line.lower()]
    return one_line((errors or lines or ["no output"])[-1])[:300]


def _try(made: MadeEnvironment, family: str) -> None:
    """Plays one of the family's environments for a few steps. Raises ConfigError when that fails."""
    env_id = next((each for each in catalogue.entries() if installs.family_of(each) == family), None)
    if env_id is None:
        return
    module = "evopolicy_worker.environments.checks.conformance"
    program = [made.python, "-P", "-m", module, str(_TRIAL_STEPS), env_id]
    done = subprocess.run(program, capture_output=True, input=b"[]\n", check=False)
    why = last_line(done.stderr.decode(errors="replace"))
    if done.returncode == 0:
        why = msgspec.json.decode(done.stdout.splitlines()[-1], type=CheckResult).verdict(None)
    if why != "ok":
        raise ConfigError(
            f"{family} is installed in {made.folder}, but {env_id} cannot be played there: {why}"
        )
