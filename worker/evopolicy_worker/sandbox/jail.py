"""How a zygote is started: inside bubblewrap, or as a plain process confined by Landlock."""

from __future__ import annotations

import ctypes
import glob
import os
import secrets
import shutil
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path

import msgspec

from evopolicy_common.errors import ConfigError, SandboxError, raised_as
from evopolicy_common.messages.episode import Tier
from evopolicy_common.processes import distribution
from evopolicy_common.processes.packages import check_alone, files_of, modules_of
from evopolicy_worker.sandbox import seccomp

INSIDE = Path(__file__).parent / "inside"
"""The only modules of this software that the sandbox shows."""
POLICY_HOME = "/home/policy"
_PACKAGES = "/packages"
_SITE_FOLDERS = ("site-packages", "dist-packages")
_PLACE = "/own"
_DEVICES = ("/dev/null", "/dev/full", "/dev/random", "/dev/urandom")
"""Without `/dev/zero`: mapped, it is shared memory without a file, and its inode numbers come from a machine-wide
counter."""
_FIRST_UID = 0x6D000000
"""As root, policies run under user ids from here on, which no machine assigns."""

ENVIRONMENT = {
    "PATH": "/usr/bin:/bin",
    "HOME": POLICY_HOME,
    "LANG": "C.UTF-8",
    "LC_ALL": "C.UTF-8",
    "TZ": "UTC",
    "PYTHONHASHSEED": "0",
    "PYTHONDONTWRITEBYTECODE": "1",
    "PYTHONNOUSERSITE": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    # Each arena reserves 64 MiB of address space, and a policy's memory limit counts address space.
    "MALLOC_ARENA_MAX": "2",
}
"""All environment variables of a policy's process."""
START = ENVIRONMENT | {"LD_BIND_NOW": "1"}
"""Those that a zygote starts with. It has its libraries' functions looked up once, which each policy's process would do
for those that it calls, and removes the additional variable."""


class _PythonFiles(msgspec.Struct, frozen=True, kw_only=True):
    """Files of this machine that the sandbox shows, read-only: the standard library, shared libraries, and
    only the allowed packages. The site-packages folder is never shown as a whole, since it has simulators and
    our own code."""

    interpreter: str
    """The interpreter's real file: not a link, nor the launcher of a virtual environment."""
    read: tuple[str, ...]
    """Files and folders, shown at their own paths."""
    libraries: tuple[str, ...]
    """Those paths in `read` that hold the system's shared libraries, of which Python needs only a few."""
    hidden: tuple[str, ...]
    """Folders below those in `read` that must appear empty."""
    packages: dict[str, str]
    """Modules, packages and their bundled libraries: name in the packages folder → path on this machine."""


class PolicyJail(msgspec.Struct, frozen=True, kw_only=True):
    """A command that starts a zygote, and the zygote's configuration."""

    command: tuple[str, ...]
    """The caller appends the number of the control socket's descriptor."""
    config: dict[str, object]
    user: int | None
    """User id outside that the worker maps the sandbox's user to; None for no mapping."""
    home: str | None
    """Folder of a policy's files; None when each policy gets a folder in the slot's scratch folder."""


def plan(
    tier: Tier,
    scratch: Path,
    allowed_packages: tuple[str, ...],
    *,
    sealed: bool = True,
    user: int | None = None,
) -> PolicyJail:
    """The jail of that tier. Raises SandboxError, with a remedy, when this machine cannot build it.

    `user`: as root, the user id outside of the sandbox's user; None picks one (`some_user`). `sealed=False` omits what
    a policy's process does to itself (limits, Landlock, the filter), for tests that show the attacks that these stop.
    """
    files = _python_files(allowed_packages)
    config: dict[str, object] = {
        "become_nobody": False,
        "namespaces": tier == "bwrap",
        "home": POLICY_HOME,
        "devices": [device for device in _DEVICES if os.path.exists(device)],
        # An interpreter installed below /tmp must stay visible. The policy's TMPDIR is elsewhere in any case.
        "own_tmp": not any(path.startswith("/tmp/") for path in files.read),
        "packages": _PACKAGES,
        "warm": modules_of(name for name in allowed_packages if name != "numpy"),
        "limits": sealed,
        "seals": tier != "none" and sealed,
        "landlock": None,
        "filter": "",
    }
    if tier != "none":
        config["filter"] = seccomp.policy_filter(sees_the_machines_files=tier == "landlock").hex()
    has_landlock = landlock_version() > 0
    if tier == "bwrap":
        if has_landlock:
            config["landlock"] = {"read": ["/"], "write": ["/tmp", "/dev"]}
        as_root = os.geteuid() == 0
        config["become_nobody"] = as_root
        # Folders that the zygote replaces by copies (of `libraries`, only the files needed), and where it makes them.
        folders: list[str] = []
        libraries: list[str] = []
        for path in filter(os.path.isdir, files.read):
            (libraries if path in files.libraries else folders).append(_shown_at(path))
        folders += [f"{_PACKAGES}/{name}" for name, path in files.packages.items() if os.path.isdir(path)]
        config |= {"folders": [*folders, "/sandbox"], "libraries": libraries, "place": _PLACE}
        return PolicyJail(
            command=(*_bubblewrap(files, as_root), *_python(files, "/sandbox")),
            config=config,
            user=(some_user() if user is None else user) if as_root else None,
            home=POLICY_HOME,
        )
    config["packages"] = str(_package_links(files, scratch))
    if tier == "landlock":
        if not has_landlock:
            raise SandboxError(
                "tier landlock needs a kernel with Landlock (5.13 or later, and enabled); see doctor"
            )
        places = [*files.read, *files.packages.values(), str(config["packages"]), str(INSIDE)]
        config["landlock"] = {"read": places, "write": list(_DEVICES)}
    return PolicyJail(command=_python(files, str(INSIDE)), config=config, user=None, home=None)


def some_user() -> int:
    """A random user id that no machine assigns, most likely a different one each time."""
    return _FIRST_UID + secrets.randbelow(0x10000)


def bubblewrap(hostname: str, *, own_user: bool, rights: Sequence[str]) -> list[str]:
    """The command line's begin: namespaces of its own, with these capabilities in them. `own_user`: also one of users.
    Raises SandboxError, with how to install it, when bubblewrap is missing."""
    bwrap = shutil.which("bwrap")
    if bwrap is None:
        raise SandboxError(f"bubblewrap is not installed: {distribution.install('bubblewrap')}")
    command = [bwrap, "--die-with-parent", "--new-session", "--hostname", hostname]
    command += ["--unshare-pid", "--unshare-net", "--unshare-ipc", "--unshare-uts", "--unshare-cgroup-try"]
    command += ["--unshare-user", "--uid", "65534", "--gid", "65534"] if own_user else []
    return command + [part for right in rights for part in ("--cap-add", right)]


def landlock_version() -> int:
    """ABI version of the kernel's Landlock; 0 without Landlock."""
    return max(0, int(ctypes.CDLL(None).syscall(444, None, 0, 1)))


def _python_files(allowed_packages: tuple[str, ...]) -> _PythonFiles:
    """For this interpreter, and these packages with their dependencies. Raises SandboxError that names the
    package when it is not installed or cannot be shown alone."""
    interpreter = os.path.realpath(getattr(sys, "_base_executable", sys.executable))
    prefix = os.path.realpath(sys.base_prefix)
    read = [interpreter]
    if prefix == "/usr":
        # In a virtual environment `platstdlib` is the environment's own folder, which has all its packages.
        base = {"platbase": sys.base_exec_prefix}
        read += [sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib", vars=base)]
    else:
        # A separate prefix (pyenv, conda, uv, /usr/local) also has shared libraries beside the standard library.
        read.append(f"{prefix}/lib")
    with raised_as(SandboxError, "packages that policies may import", ConfigError):
        packages = files_of(allowed_packages)
        if more := [name for name in allowed_packages if name != "numpy"]:
            check_alone(more)
    # The C library, its loader and the system's shared libraries.
    libraries = ["/lib64", "/etc/ld.so.cache", "/lib", "/usr/lib64", "/usr/lib"]
    triplet = sysconfig.get_config_var("MULTIARCH")
    if triplet and os.path.isdir(f"/lib/{triplet}"):
        libraries[2:] = [f"/lib/{triplet}", f"/usr/lib/{triplet}", *map(str, Path("/lib").glob("ld-linux*"))]
    read += libraries
    # Not resolved: `/lib` is a link to `/usr/lib` on most systems, and both names are used.
    existing = tuple(dict.fromkeys(path for path in read if os.path.exists(path)))
    # Folders of installed packages below them.
    below = [folder for root in existing for folder in (root, *glob.glob(f"{root}/python3*"))]
    site = filter(os.path.isdir, (f"{folder}/{name}" for folder in below for name in _SITE_FOLDERS))
    return _PythonFiles(
        interpreter=interpreter,
        read=existing,
        libraries=tuple(path for path in existing if path in libraries),
        hidden=tuple(sorted({*map(os.path.realpath, site)})),
        packages=packages,
    )


def _python(files: _PythonFiles, folder: str) -> tuple[str, ...]:
    # No site (-S), no user site (-s), no script folder on the path (-P): only the standard library and allowed
    # packages.
    return (files.interpreter, "-s", "-S", "-P", "-B", f"{folder}/zygote.py")


def _bubblewrap(files: _PythonFiles, as_root: bool) -> list[str]:
    # As root, the zygote makes the user namespace itself, so that the policy's user is unprivileged outside too.
    rights = ("CAP_SYS_ADMIN", *(("CAP_SETUID", "CAP_SETGID") if as_root else ()))
    command = [*bubblewrap("policy", own_user=not as_root, rights=rights), "--clearenv"]
    for name, value in START.items():
        command += ["--setenv", name, value]
    for path in parents([*files.read, *map(os.path.realpath, files.read), "/dev/null", POLICY_HOME]):
        command += ["--perms", "0755", "--dir", path]
    for path in files.read:
        if os.path.isdir(path) and (target := _shown_at(path)) != path:
            command += ["--ro-bind", target, target, "--symlink", target, path]
        else:
            command += ["--ro-bind", path, path]
    for path in files.hidden:
        command += ["--tmpfs", path, "--remount-ro", path]
    command += ["--perms", "0755", "--dir", _PACKAGES]
    for name, path in files.packages.items():
        command += ["--ro-bind", path, f"{_PACKAGES}/{name}"]
    command += ["--ro-bind", str(INSIDE), "/sandbox"]
    for device in _DEVICES:
        if os.path.exists(device):
            command += ["--dev-bind", device, device]
    for path in (POLICY_HOME, "/tmp", _PLACE):
        command += ["--dir", path]
    return [*command, "--chdir", "/", "--remount-ro", "/"]


def _shown_at(path: str) -> str:
    """The folder's real path when it is a link: the sandbox shows it there, with the same link."""
    return os.path.realpath(path) if os.path.islink(path) else path


def parents(paths: list[str]) -> list[str]:
    """All parent folders of these paths, to be made explicitly: bubblewrap makes them accessible to its own user
    alone."""
    return sorted({str(parent) for path in paths for parent in Path(path).parents} - {"/"})


def _package_links(files: _PythonFiles, scratch: Path) -> Path:
    """Makes a folder that has only links to the allowed packages."""
    folder = scratch / "packages"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, path in files.packages.items():
        (folder / name).symlink_to(path)
    return folder
