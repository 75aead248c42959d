"""`evopolicy-worker setup FAMILY…`: makes a virtual environment of its own for families of environments.

It gets this version of evopolicy with the families' extras, in the versions of `constraints.txt` and the families'
pins. At the end one environment of each family is played in it for a few steps.
"""

from __future__ import annotations

import base64
import contextlib
import fcntl
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Annotated
from urllib.parse import unquote, urlsplit

import msgspec
import typer

import evopolicy_common
from evopolicy_common import catalogue
from evopolicy_common.catalogue import installs
from evopolicy_common.catalogue.installs import Install, Made
from evopolicy_common.cli.conventions import fail_on_our_errors
from evopolicy_common.errors import ConfigError, MachineError
from evopolicy_common.processes.parent_death import ending_with_parent
from evopolicy_common.processes.preflight import check_writable
from evopolicy_common.terminal import one_line, say
from evopolicy_worker.environments.browser import chromium
from evopolicy_worker.environments.checks.conformance import CheckResult
from evopolicy_worker.environments.interface.settings import BROWSER

DISTRIBUTION = "evopolicy"
_PIP = ("-m", "pip", "--disable-pip-version-check", "--no-input")
_NO_NETWORK = re.compile(
    r"NewConnectionError|name resolution|Network is unreachable|Connection refused|ConnectTimeout"
    r"|Max retries|ProxyError|from versions: none",
    re.IGNORECASE,
)
_NO_VERSION = re.compile(r"No matching distribution found for ([^\s(]+)")
_TRIAL_STEPS = 5


def command(
    family: Annotated[list[str], typer.Argument(help="Families to install, such as atari.")],
    into: Annotated[
        Path | None,
        typer.Option(help="Folder of the virtual environment; default: one in the user's data folder."),
    ] = None,
    python: Annotated[
        str | None, typer.Option(help="Interpreter of the virtual environment; default: this one.")
    ] = None,
) -> None:
    """Install families of environments, in tested versions, into a virtual environment of their own.

    Example: evopolicy-worker setup mo_gymnasium

    Use this for families whose packages conflict with those installed here, or to keep this installation unchanged.
    Local commands find it and start a worker from it. For web pages, root also installs Chromium.
    """
    with fail_on_our_errors(), contextlib.ExitStack() as stack:
        wanted = _wanted(family)
        folder = (into or installs.root() / "+".join(wanted)).absolute()
        if folder.is_symlink():  # made by an earlier --into, whose folder is written anew
            folder = folder.resolve()
        _check_free(folder)
        check_writable(folder.parent, "--into")
        folder.parent.mkdir(parents=True, exist_ok=True)
        lock = stack.enter_context((folder.parent / f".{folder.name}.lock").open("w"))
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"another setup is installing into {folder}: wait until it has ended, or name another folder with"
                " --into"
            ) from None
        _make(wanted, folder, python or sys.executable)
        _link(folder, "+".join(wanted))
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
    pinned = [name for name, each in wanted.items() if each.pins]
    if pinned and len(wanted) > 1:
        raise ConfigError(
            f"{pinned[0]} excludes packages of other families: set it up alone, with `{installs.setup_line(pinned[0])}`"
        )
    return wanted


def _check_free(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"--into {folder} is not a folder; name a new one")
    if folder.exists() and installs.read(folder) is None and any(folder.iterdir()):
        raise ConfigError(f"--into {folder}: the folder has other files; name a new one")


def _make(wanted: Mapping[str, Install], folder: Path, python: str) -> None:
    """Makes the virtual environment in `folder`, in place of an earlier one. Raises ConfigError or MachineError."""
    _check_free(folder)
    _check_python(wanted, python)
    if any(each.browser for each in wanted.values()):
        install_browser()
    needed = max(each.megabytes for each in wanted.values()) + sum(60 for _ in wanted)
    check_writable(folder, "--into", least_bytes=needed << 20)
    made = Made(families=tuple(wanted), version=evopolicy_common.__version__)
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    mark = folder / installs.MARK
    mark.write_bytes(msgspec.json.format(msgspec.json.encode(made)))
    say(f"installing into {folder}: a minute or more, about {needed} MB", err=True)
    _run([python, "-m", "venv", str(folder)], "the virtual environment")
    own = msgspec.structs.replace(made, folder=str(folder))
    with tempfile.TemporaryDirectory(prefix="evopolicy-setup-") as scratch:
        pins = Path(scratch, "constraints.txt")
        pins.write_text(constraints(wanted))
        extras = ",".join(each.extra for each in wanted.values())
        install = [own.python, *_PIP, "install", "--quiet", "--constraint", str(pins)]
        _run([*install, *_ourselves(Path(scratch), extras)], ", ".join(wanted))
        if apart := installs.apart(wanted):
            _run([own.python, *_PIP, "install", "--quiet", "--no-deps", *apart], ", ".join(apart))
    for name in wanted:
        _try(own, name)
    mark.write_bytes(msgspec.json.format(msgspec.json.encode(msgspec.structs.replace(made, ready=True))))


def install_browser() -> None:
    """Installs Chromium where there is none: as root with apt-get. Otherwise raises MachineError that says how."""
    lacking = chromium.lacking()
    if not lacking:
        return
    if os.environ.get(BROWSER) or os.geteuid() or shutil.which("apt-get") is None:
        raise MachineError(f"missing: {lacking}; then set the family up again")
    say("installing chromium with apt-get", err=True)
    install = ["apt-get", "install", "-y", "-q", "--no-install-recommends", "chromium"]
    for program in (install, ["apt-get", "update", "-q"], install):
        done = subprocess.run(program, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
        chromium.program.cache_clear()
        if program is install and done.returncode == 0 and not chromium.lacking():
            return
    raise MachineError(
        f"chromium cannot be installed: {last_line(done.stderr + done.stdout)}; install it by hand, or name one in"
        " EVOPOLICY_BROWSER"
    )


def _check_python(wanted: Mapping[str, Install], python: str) -> None:
    try:
        command = [python, "-c", "import sys, venv, ensurepip; print(*sys.version_info[:2], sep='.')"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise ConfigError(f"--python {python} cannot be started: {error.strerror}") from error
    if done.returncode:
        raise ConfigError(
            f"{python} makes no virtual environments: {last_line(done.stderr)}; install its venv module (Debian:"
            " python3-venv) or name another with --python"
        )
    for name, each in wanted.items():
        if not _numbers(each.python[0]) <= _numbers(done.stdout) < _numbers(each.python[1]):
            raise ConfigError(
                f"{name} is tested with Python {each.python[0]} up to, but not including, {each.python[1]}, and"
                f" {python} is {done.stdout.strip()}: name another with --python"
            )


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.strip().split("."))


def constraints(wanted: Mapping[str, Install]) -> str:
    """Lines for pip: those of `constraints.txt`, with the families' pins in place of their own."""
    pins = {
        _normal(name): f"{name}=={version}" for each in wanted.values() for name, version in each.pins.items()
    }
    package = Path(evopolicy_common.__file__).parent
    # In a wheel it is among the shipped files, in a checkout at its top.
    places = (package.parent / "evopolicy_gateway", package.parents[1])
    usual = next((file for each in places if (file := each / "constraints.txt").is_file()), None)
    if usual is None:
        raise ConfigError("constraints.txt is missing from this installation: install evopolicy again")
    lines = usual.read_text("utf-8").splitlines()
    kept = [line for line in lines if _normal(re.split(r"[=;]", line)[0]) not in pins]
    return "\n".join([*kept, *pins.values()]) + "\n"


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name.strip()).lower()


def _ourselves(scratch: Path, extras: str) -> list[str]:
    """pip's arguments for this very version of evopolicy: the checkout that is installed, or a wheel of the installed
    files."""
    installed = metadata.distribution(DISTRIBUTION)
    origin = json.loads(installed.read_text("direct_url.json") or "{}")
    if origin.get("dir_info", {}).get("editable"):
        return ["--editable", f"{unquote(urlsplit(origin['url']).path)}[{extras}]"]
    return [f"{wheel(installed, scratch)}[{extras}]"]


def wheel(installed: metadata.Distribution, folder: Path) -> Path:
    """A wheel of an installed distribution's files, written into `folder`."""
    path = folder / f"{DISTRIBUTION}-{installed.version}-py3-none-any.whl"
    records, own = [], ""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for each in installed.files or ():
            name = each.as_posix()
            if name.endswith(".dist-info/RECORD"):
                own = name
            made_by_pip = name.endswith(("/INSTALLER", "/REQUESTED", "/direct_url.json", ".pyc"))
            if name.startswith(("..", "/")) or made_by_pip or name == own:
                continue
            data = Path(str(each.locate())).read_bytes()
            digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
            records.append(f"{name},sha256={digest},{len(data)}\n")
            file.writestr(name, data)
        file.writestr(own, "".join([*records, f"{own},,\n"]))
    return path


def _run(program: Sequence[str], part: str) -> None:
    # pip ends with this process: otherwise it would go on to write into a folder that is made again.
    done = subprocess.run(
        ending_with_parent(program), capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL
    )
    if done.returncode:
        raise failure(part, done.stderr + done.stdout)


def failure(part: str, output: str) -> ConfigError:
    """The error for a failed step of the installation, from the program's output."""
    if _NO_NETWORK.search(output):
        return MachineError(
            f"{part}: no package index with it can be reached: check the network, and pip's index-url and proxy (`pip"
            " config list`)"
        )
    if "No space left" in output or "Errno 28" in output:
        return MachineError(f"{part}: no space is left; make room, or name another folder with --into")
    if match := _NO_VERSION.search(output):
        return ConfigError(
            f"{part}: the package index has no {match[1]} for this Python and platform; name another interpreter with"
            " --python"
        )
    return ConfigError(f"{part} cannot be installed: {last_line(output)}")


def last_line(output: str) -> str:
    """The last line of a program's output that says something, errors first."""
    lines = [line for line in output.splitlines() if line.strip()]
    errors = [line for line in lines if "error" in line.lower()]
    return one_line((errors or lines or ["no output"])[-1])[:300]


def _try(made: Made, family: str) -> None:
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


def _link(folder: Path, name: str) -> None:
    """Makes local commands find a virtual environment in another folder. They use the latest, so that one in the
    default folder stays beside it."""
    root = installs.root()
    if folder.parent.resolve() == root.resolve():
        return
    root.mkdir(parents=True, exist_ok=True)
    entry = root / name
    if entry.exists() and not entry.is_symlink():
        entry = root / f"{name}-{hashlib.sha256(bytes(folder)).hexdigest()[:8]}"
    entry.unlink(missing_ok=True)
    entry.symlink_to(folder)
