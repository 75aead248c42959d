"""The jail of a slot's environment process. It limits what simulators, which are third-party code, can see and do.

Rules:
- No credentials, no network, and no environment variables but those listed here. Installed code is read-only; only the
  slot's scratch folder is writable. Only the supervisor has a session with the coordinator.
- Of the operator's other folders on the module search path: their modules and declared data (`user_code`).
- Tier bwrap: its own namespaces, in which the machine's processes, sockets and other files do not exist. Tier landlock:
  Landlock and a filter of system calls instead. Tier none: only the environment variables are restricted.
- The process starts the policies' sandbox inside its jail, then seals itself, and only then imports a simulator.
  Policies are its descendants, because it must be able to kill them, and a process cannot signal into a sibling
  namespace.
"""

from __future__ import annotations

import contextlib
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

import evopolicy_common
from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import SandboxError
from evopolicy_common.messages.episode import Tier
from evopolicy_common.processes.scratch import remove_tree
from evopolicy_common.seccomp import SECCOMP
from evopolicy_worker.environments import defined, process_environment
from evopolicy_worker.environments.interface import calls
from evopolicy_worker.environments.interface.settings import BROWSER
from evopolicy_worker.sandbox import jail, seccomp, user_code
from evopolicy_worker.sandbox.inside import zygote as inside

_SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64")
_ETC = ("ld.so.cache", "alternatives", "fonts", "glvnd", "drirc", "localtime", "nvidia", "vulkan", "OpenCL")
_DEVICES = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom")
_GRAPHICS = ("/dev/dri", "/dev/nvidia*", "/sys/dev/char", "/sys/devices", "/sys/bus/pci")
"""Paths that a driver needs to render with a graphics card. Without one, Mesa renders on the CPU and needs none of
them."""
_SCOPES_SIGNALS = 6
"""First ABI version of Landlock that blocks signals to processes outside."""
_UNHEEDING = ("/bin/sh", "-c", 'trap "" TERM; exec "$@"', "sh")
"""Runs a program that ignores SIGTERM: a batch system sends it to bubblewrap too, and the worker decides when a slot
ends."""
_SHELLS_OWN = ("PWD", "OLDPWD", "SHLVL", "_")
"""Variables that some shells add."""
_SET_MODE_FILTER, _ALL_THREADS, _SPECULATION = 1, 1, 4
_CHECK_S = 20.0

_PASSED_ON = ("LD_LIBRARY_PATH", "LANG", "LANGUAGE", BROWSER)
_PASSED_ON_PREFIXES = (
    *("EGL_", "GALLIUM_", "LIBGL_", "LP_", "MESA_"),
    *("MUJOCO_", "PYOPENGL_", "__EGL_", "__GLX_"),
)
_LATER_PATH = "EVOPOLICY_SIMULATORS_PATH"
"""Passes the operator's PYTHONPATH into the jail, where `seal` applies it: its modules could shadow standard ones."""
_INSTALLATIONS = ("site-packages", "dist-packages")
_own_folders: dict[str, str] = {}
"""Folders on the module search path of which only modules are shown, and what the process has in their place."""


def variables(scratch: Path) -> dict[str, str]:
    own = {name: os.environ[name] for name in os.environ if name.startswith(_PASSED_ON_PREFIXES)}
    own |= {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    path = [os.path.abspath(entry) for entry in _folders("PYTHONPATH")]
    if ours := [entry for entry in path if os.path.realpath(entry) in _our_folders()]:
        own["PYTHONPATH"] = os.pathsep.join(ours)
    own |= {_LATER_PATH: os.pathsep.join(path), "PATH": "/usr/bin:/bin", "PYTHONDONTWRITEBYTECODE": "1"}
    return own | {"HOME": f"{scratch}/home", "TMPDIR": f"{scratch}/tmp"} | process_environment()


def command(
    tier: Tier, scratch: Path, *, draws: bool = False, definitions: Sequence[Entry] = ()
) -> tuple[str, ...]:
    """The command line that starts an environment process in that tier.

    `draws`: whether this machine's graphics devices are visible. `definitions`: environments that do not ship. Raises
    SandboxError when bubblewrap is not installed.
    """
    python = (sys.executable, "-P", "-m", "evopolicy_worker.episodes.env_process")
    if tier != "bwrap":
        return python
    declared = user_code.declared(definitions, _folders("PYTHONPATH"))
    return (*_UNHEEDING, *_bubblewrap(scratch, draws, declared), *python)


def graphics_devices() -> tuple[str, ...]:
    """Paths that rendering with this machine's graphics card needs; empty where Mesa renders on the CPU."""
    if not any(Path("/").glob(pattern.lstrip("/")) for pattern in _GRAPHICS[:2]):
        return ()
    return tuple(str(path) for pattern in _GRAPHICS for path in sorted(Path("/").glob(pattern.lstrip("/"))))


# The rest runs in the process itself, before any simulator is imported.


def enclose(tier: Tier, scratch: Path, *, draws: bool) -> None:
    """The first half of the seal, before the policies' sandbox starts: in tier landlock, restricts the visible files.

    `draws`: whether graphics devices stay visible. Raises SandboxError when it fails.
    """
    for name in ("home", "tmp"):
        (scratch / name).mkdir(exist_ok=True)
    os.chdir(scratch / "home")
    later = _folders(_LATER_PATH)
    _own_folders.update((each, each) for each in (*sys.path, *later) if not _is_installed(each))
    if tier == "landlock":
        declared = user_code.declared(defined(), later)
        for n, folder in enumerate(_own_folders):
            # Beside the scratch folder, in which this process may write.
            place = Path(f"{scratch}-modules", str(n))
            _own_folders[folder] = str(place)
            remove_tree(place)
            below = (each for each in declared if _below(each, folder))
            user_code.mirror(folder, {*user_code.modules(folder), *below}, place)
        drawn_with = graphics_devices() if draws else ()
        devices = [path for path in drawn_with if path.startswith("/dev/")]
        other = [path for path in drawn_with if path not in devices]
        shown = [*_code(declared), f"{scratch}-modules", *_etc(), *_SYSTEM, "/proc", *other]
        with _explained("be closed in by Landlock"):
            inside.check(inside.libc.prctl(38, 1, 0, 0, 0), "no_new_privs")
            inside.landlock({"read": shown, "write": [*_DEVICES, *devices]}, str(scratch))


def seal(tier: Tier, scratch: Path, user: int | None, *, draws: bool) -> None:
    """The second half, once the policies' sandbox runs: drops all capabilities, and refuses namespaces and many system
    calls. Then adds the folders of the operator's PYTHONPATH to the module search path.

    `user` (as root, tier bwrap): the policies' user, which this process becomes so that it may kill their processes.
    Raises SandboxError when it fails.
    """
    if tier != "none":
        _seal(tier, scratch, user, graphics_devices() if draws else ())
    later = _folders(_LATER_PATH)
    sys.path[:] = [_own_folders.get(entry, entry) for entry in (*later, *sys.path)]
    os.environ["PYTHONPATH"] = os.pathsep.join(_own_folders.get(entry, entry) for entry in later)
    if tier != "none":
        calls.own_folders += _own_folders.values()


def _seal(tier: Tier, scratch: Path, user: int | None, drawn_with: tuple[str, ...]) -> None:
    with _explained("seal itself"):
        if user is not None:
            groups = sorted({os.stat(path).st_gid for path in drawn_with})
            for path in (scratch, *scratch.iterdir()):
                os.chown(path, user, user)
            os.setgroups(groups)
            os.setresgid(user, user, user)
            os.setresuid(user, user, user)
            # Changing the user made this process undumpable, which denies it /proc/self.
            inside.check(inside.libc.prctl(4, 1, 0, 0, 0), "dumpable")
        inside.drop_capabilities()
        inside.check(inside.libc.prctl(38, 1, 0, 0, 0), "no_new_privs")
        namespaces = tier == "bwrap"
        signals = namespaces or jail.landlock_version() >= _SCOPES_SIGNALS
        program = seccomp.environment_filter(namespaces=namespaces, signals=signals)
        # For all threads, without the mitigations with which older kernels slow filtered processes.
        arguments, _buffer = inside.filter_of(program, os.getpid())
        number, flags = SECCOMP[platform.machine()], _ALL_THREADS | _SPECULATION
        inside.check(inside.libc.syscall(number, _SET_MODE_FILTER, flags, arguments), "seccomp")


@contextlib.contextmanager
def expendable() -> Iterator[None]:
    """Processes started inside are the first to be killed when the machine runs out of memory."""
    path = Path("/proc/self/oom_score_adj")
    before = path.read_text()
    with contextlib.suppress(OSError):
        path.write_text("1000")
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            path.write_text(before)


@contextlib.contextmanager
def _explained(attempt: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise SandboxError(f"the environment process cannot {attempt}: {error}") from error


# The file system of the process.


def _bubblewrap(scratch: Path, draws: bool, declared: Sequence[str]) -> list[str]:
    as_root = os.geteuid() == 0
    # As root, all rights are needed to start the policies' sandbox; `seal` drops them when it changes the user.
    arguments = jail.bubblewrap("slot", own_user=not as_root, rights=("ALL",) if as_root else ())
    for name in _SHELLS_OWN:
        arguments += ["--unsetenv", name]
    for path in _SYSTEM:
        if os.path.islink(path):
            arguments += ["--symlink", os.readlink(path), path]
        elif os.path.isdir(path):
            arguments += ["--ro-bind", path, path]
    arguments += ["--proc", "/proc"]
    for path in ("/tmp", "/dev/shm"):
        arguments += ["--perms", "1777", "--tmpfs", path]
    for path in _DEVICES:
        if os.path.exists(path):
            arguments += ["--dev-bind", path, path]
    read = (*_etc(), *_code(declared))
    drawn_with = graphics_devices() if draws else ()
    for path in jail.parents([*read, *drawn_with, *_DEVICES, str(scratch)]):
        arguments += ["--perms", "0755", "--dir", path]
    for path in read:
        arguments += ["--ro-bind", path, path]
    for path in drawn_with:
        arguments += ["--dev-bind" if path.startswith("/dev/") else "--ro-bind", path, path]
    return [*arguments, "--bind", str(scratch), str(scratch), "--remount-ro", "/", "--chdir", str(scratch)]


def _etc() -> list[str]:
    return [path for name in _ETC if os.path.exists(path := f"/etc/{name}")]


def _code(declared: Sequence[str]) -> list[str]:
    """Python, its installed packages, the folders of libraries, the modules in the operator's other folders, and what
    is declared. Paths inside other ones are left out."""
    path = [*_python_path(), *_folders("PYTHONPATH"), *_folders(_LATER_PATH)]
    named = _folders("LD_LIBRARY_PATH")
    named += [os.path.dirname(os.path.realpath(path)) for path in (os.environ.get(BROWSER, ""),) if path]
    named += filter(_is_installed, path)
    home = os.path.realpath(os.path.expanduser("~"))
    listed = [entry for entry in named if not _below(home, os.path.realpath(entry).rstrip("/"))]
    wanted = [*_installation(), *listed]
    places = {*map(os.path.abspath, wanted), *map(os.path.realpath, wanted)}
    own = [entry for entry in path if not _is_installed(entry)]
    for folder in {*map(os.path.abspath, own), *map(os.path.realpath, own)}:
        places |= {*user_code.modules(folder)}
    outermost: list[str] = []
    for place in sorted({*places, *declared}):
        if os.path.exists(place) and not any(_below(place, other) for other in ("/usr", *outermost)):
            outermost.append(place)
    return outermost


def _folders(variable: str) -> list[str]:
    return [entry for entry in os.environ.get(variable, "").split(os.pathsep) if entry]


def _installation() -> list[str]:
    return [sys.prefix, sys.exec_prefix, sys.base_prefix, *_our_folders()]


def _is_installed(path: str) -> bool:
    """Whether a place on the module search path is Python's, ours, or a folder of installed packages, and no folder of
    the operator's, which may hold anything."""
    real = os.path.realpath(path)
    if os.path.basename(real) in _INSTALLATIONS or not os.path.isdir(real):
        return True
    return any(_below(real, os.path.realpath(folder)) for folder in ("/usr", *_installation()))


def _our_folders() -> list[str]:
    ours = str(Path(__file__).parents[2])
    return [os.path.realpath(folder) for folder in (os.path.dirname(evopolicy_common.__path__[0]), ours)]


def _below(path: str, folder: str) -> bool:
    return path == folder or path.startswith(folder + "/")


@cache
def _python_path() -> tuple[str, ...]:
    """Module search path of a fresh interpreter, the only way to learn what .pth files add."""
    program = "import sys; print('\\0'.join(sys.path), end='')"
    output = subprocess.run(
        [sys.executable, "-P", "-c", program], capture_output=True, text=True, check=True, timeout=_CHECK_S
    )
    return tuple(filter(None, output.stdout.split("\0")))
