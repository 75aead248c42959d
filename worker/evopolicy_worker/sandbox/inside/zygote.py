"""The zygote inside the sandbox: forks a process per policy, which seals itself before it reads the bundle.

- The zygote never reads a bundle: imported there, hostile code would own every later episode. It has numpy imported.
- Each child is pid 1 of a pid namespace of its own, with mounts of its own, and then gives up all that it could do:
  capabilities, new privileges, files outside (Landlock), system calls (the filter), limits.
- Started as root it first becomes an unprivileged user of a user namespace.

Standard library and numpy only: the sandbox shows nothing else.
"""

import ctypes
import gc
import importlib
import importlib.util
import io
import json
import os
import resource
import signal
import socket
import struct
import sys
import traceback
from typing import Any

CLONE_NEWNS, CLONE_NEWIPC, CLONE_NEWUSER, CLONE_NEWPID = 0x00020000, 0x08000000, 0x10000000, 0x20000000
MS_RDONLY, MS_NOSUID, MS_NODEV, MS_REMOUNT, MS_BIND, MS_REC, MS_PRIVATE = 1, 2, 4, 32, 4096, 16384, 1 << 18
NOBODY = 65534
PID_MARK = 0x7FFFABCD
MAX_TEXT = 16_000

libc = ctypes.CDLL(None, use_errno=True)
player: Any = None
"""The module `player`: imports numpy, so not before the path to it is known."""


def check(result: int, what: str) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{what}: {os.strerror(number)}")
    return result


def main() -> None:
    libc.prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    control = socket.socket(fileno=int(sys.argv[1]))
    config = json.loads(control.recv(1 << 18))
    try:
        if config["become_nobody"]:
            enter_user_namespace(control)
        sys.path.append(config["packages"])
        warm(config["warm"])
        if config["namespaces"]:
            for device in config["devices"]:
                protect(device)
            # Tried once here, so that a host which cannot do it is told at the start.
            fork_isolated(os.pidfd_open(os.getpid()), probe=True)
    except BaseException as error:
        control.send(json.dumps({"error": f"{type(error).__name__}: {error}"}).encode())
        raise
    fds = zygote(control, config)
    # Only a policy's process comes here. It must never go on as the zygote, whatever happens.
    del control
    try:
        policy_process(config, fds)
    finally:
        os._exit(70)


def enter_user_namespace(control: socket.socket) -> None:
    """Started as root: goes on as an unprivileged user, pid 1 of namespaces that this user owns."""
    os.setgroups([])
    wait_if_parent(os.fork(), control)
    check(libc.unshare(CLONE_NEWUSER), "unshare user")
    # Only the outside may say who we are.
    fd = os.pidfd_open(os.getpid())
    socket.send_fds(control, [b'{"map": true}'], [fd])
    os.close(fd)
    if control.recv(100) != b"mapped":
        raise OSError("the worker did not map this namespace's user")
    os.setresgid(NOBODY, NOBODY, NOBODY)
    os.setresuid(NOBODY, NOBODY, NOBODY)
    check(libc.unshare(CLONE_NEWPID | CLONE_NEWNS | CLONE_NEWIPC), "unshare pid, mounts, ipc")
    check(libc.mount(b"none", b"/", None, MS_REC | MS_PRIVATE, None), "private mounts")
    wait_if_parent(os.fork(), control)


def wait_if_parent(child: int, control: socket.socket) -> None:
    if child:
        control.close()
        _, status = os.waitpid(child, 0)
        os._exit(os.waitstatus_to_exitcode(status) & 0x7F)


def protect(device: str) -> None:
    """Read-only, which leaves a device's data as it is: who may write could set its times, for all the machine to see."""
    # These may not be taken away in a namespace, so they are named again; ST_ and MS_ are the same numbers.
    flags = os.statvfs(device).f_flag & (os.ST_NOSUID | os.ST_NODEV | os.ST_NOEXEC)
    flags |= MS_REMOUNT | MS_BIND | MS_RDONLY
    check(libc.mount(None, device.encode(), None, flags, None), f"protect {device}")


def warm(modules: list[str]) -> None:
    """Imports what every policy may use, so that children share it."""
    global player
    # Not by the path: a bundle may have a module of that name.
    spec = importlib.util.spec_from_file_location(
        "_player", os.path.join(os.path.dirname(__file__), "player.py")
    )
    assert spec is not None
    assert spec.loader is not None
    player = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(player)

    np = player.np
    for name in ("numpy.random", "numpy.linalg", "numpy.fft", *modules):
        importlib.import_module(name)
    np.random.default_rng(0).standard_normal(2)
    np.dot(np.eye(3), np.ones(3))
    for name in (
        "math",
        "collections",
        "dataclasses",
        "typing",
        "heapq",
        "itertools",
        "functools",
        "pathlib",
    ):
        importlib.import_module(name)
    traceback.format_exception(ValueError("warm"))
    gc.collect()
    gc.freeze()


def zygote(control: socket.socket, config: dict[str, Any]) -> list[int]:
    """Serves the worker until it hangs up; returns in every child, with its descriptors.

    A policy can look into the frames of its callers: in this one it would find how long the policies before it took.
    """
    myself = os.pidfd_open(os.getpid()) if config["namespaces"] else -1
    control.send(b'{"ready": true}')
    while True:
        message, fds, _, _ = socket.recv_fds(control, 4096, 4)
        if not message:
            os._exit(0)
        request = json.loads(message)
        if "wait" in request:
            _, status, usage = os.wait4(request["wait"], 0)
            answer = {
                "status": status,
                "cpu_s": usage.ru_utime + usage.ru_stime,
                "peak_bytes": usage.ru_maxrss * 1024,
            }
            control.send(json.dumps(answer).encode())
            continue
        try:
            child = fork_isolated(myself)
        except OSError as error:
            control.send(json.dumps({"error": f"fork: {error}"}).encode())
            continue
        if child == 0:
            return fds
        for fd in fds:
            os.close(fd)
        fd = os.pidfd_open(child)
        socket.send_fds(control, [json.dumps({"pid": child}).encode()], [fd])
        os.close(fd)


def fork_isolated(myself: int, probe: bool = False) -> int:
    """fork(), the child being pid 1 of a new pid namespace. `myself` is this process's pidfd; −1: a plain fork."""
    if myself < 0:
        return os.fork()
    check(libc.unshare(CLONE_NEWPID), "unshare pid")
    try:
        child = os.fork()
    except OSError:
        child = -1
    if child != 0:
        # Else the next child would be born into the namespace of this one.
        check(libc.setns(myself, CLONE_NEWPID), "setns pid")
    if child < 0:
        raise OSError("cannot fork")
    if probe:
        if child == 0:
            result = libc.unshare(CLONE_NEWNS | CLONE_NEWIPC)
            os._exit(1 if result < 0 else 0)
        _, status = os.waitpid(child, 0)
        os.close(myself)
        if status:
            raise OSError("a process in the sandbox may not make mount namespaces")
    return child


# One policy's process.


def policy_process(config: dict[str, Any], fds: list[int]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    libc.prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    arrange_descriptors(fds)
    fds.clear()
    try:
        if config["namespaces"]:
            check(libc.unshare(CLONE_NEWNS | CLONE_NEWIPC), "unshare mounts, ipc")
            check(libc.mount(b"none", b"/", None, MS_REC | MS_PRIVATE, None), "private mounts")
        header = bytearray(player.REQUEST_HEADER.size)
        player.read_exactly(header)
        length, kind, json_length = player.REQUEST_HEADER.unpack(header)
        body = bytearray(length)
        player.read_exactly(body)
        if kind != player.INIT:
            raise OSError("the first request is not INIT")
        init = json.loads(bytes(body[:json_length]))
        if config["namespaces"]:
            mount_home(init, config["own_tmp"])
        write_bundle(init, memoryview(body)[json_length:])
        seal(config, init)
    except BaseException as error:
        player.reply(player.FAULT, f"{type(error).__name__}: {error}".encode()[:MAX_TEXT])
        os._exit(71)
    del body, header, config
    player.play(init)


def arrange_descriptors(fds: list[int]) -> None:
    """Requests on 3, replies on 4, output on 1 and 2, an empty input of its own on 0; everything else closed."""
    high = [os.dup2(fd, 100 + k) for k, fd in enumerate(fds)]
    # Not the zygote's: the flags of an open file are the same for all who share it, and would outlive the episode.
    os.dup2(os.open("/dev/null", os.O_RDWR), 0)
    for fd, target in zip(high, (player.REQUESTS, player.REPLIES, 1, 2), strict=True):
        os.dup2(fd, target)
    os.closerange(5, 1024)
    sys.stdout, sys.stderr = output_stream(1), output_stream(2)


def output_stream(fd: int) -> io.TextIOWrapper:
    """Text that is written line by line: what was printed before a policy is killed is kept."""
    raw = io.BufferedWriter(io.FileIO(fd, "w", closefd=False))
    return io.TextIOWrapper(raw, encoding="utf-8", errors="backslashreplace", line_buffering=True)


def mount_home(init: dict[str, Any], own_tmp: bool) -> None:
    """A file system of the policy's own and limited size, for its copy of `system/` and for /tmp."""
    home = init["home"].encode()
    options = f"size={init['home_bytes']},nr_inodes={init['home_inodes']},mode=0700".encode()
    check(libc.mount(b"home", home, b"tmpfs", MS_NOSUID | MS_NODEV, options), "mount home")
    os.mkdir(home + b"/tmp")
    if own_tmp:
        check(libc.mount(home + b"/tmp", b"/tmp", None, MS_BIND, None), "bind /tmp")


def write_bundle(init: dict[str, Any], data: memoryview) -> None:
    system = init["home"] + "/system"
    os.makedirs(system, exist_ok=True)
    os.makedirs(init["home"] + "/tmp", exist_ok=True)
    os.chdir(system)
    at = 0
    for path, executable, size in init["files"]:
        if "/" in path:
            os.makedirs(os.path.dirname(path), exist_ok=True)
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o755 if executable else 0o644)
        end = at + size
        while at < end:
            at += os.write(fd, data[at:end])
        os.close(fd)


def seal(config: dict[str, Any], init: dict[str, Any]) -> None:
    """From here on this process can do less than any other; nothing of it can be undone."""
    if config["limits"]:
        for name, value in init["limits"].items():
            kind = getattr(resource, name)
            _, most = resource.getrlimit(kind)
            if most != resource.RLIM_INFINITY:
                # What this machine allows to nobody is not asked for.
                value = min(value, most)
            resource.setrlimit(kind, (value, value))
    if config["seals"]:
        drop_capabilities()
        check(libc.prctl(38, 1, 0, 0, 0), "no_new_privs")
        if config["landlock"]:
            landlock(config["landlock"], init["home"])
        install_filter(bytes.fromhex(config["filter"]))


def drop_capabilities() -> None:
    libc.prctl(47, 4, 0, 0, 0)  # PR_CAP_AMBIENT_CLEAR_ALL
    header = struct.pack("<Ii", 0x20080522, 0)
    check(libc.capset(header, bytes(24)), "capset")


def landlock(rules: dict[str, list[str]], home: str) -> None:
    """Limits what is opened to the given paths; where the kernel can, also TCP, abstract sockets and signals."""
    abi = libc.syscall(444, None, 0, 1)
    if abi < 1:
        raise OSError("the kernel lost its Landlock")
    every = (1 << (13, 14, 15, 15, 16)[min(abi, 5) - 1]) - 1
    attributes = struct.pack("<QQQ", every, 3 if abi >= 4 else 0, 3 if abi >= 6 else 0)
    size = 24 if abi >= 6 else 16 if abi >= 4 else 8
    ruleset = check(libc.syscall(444, attributes, size, 0), "landlock_create_ruleset")
    read, of_files = 0b1101, 0b1100000000000111
    # Everything but devices, sockets and pipes may be made in the policy's own home.
    write = every & ~0b111001000000
    wanted = [(path, read) for path in rules["read"]] + [(path, write) for path in (*rules["write"], home)]
    for path, access in wanted:
        try:
            fd = os.open(path, os.O_PATH | os.O_CLOEXEC)
        except FileNotFoundError:
            continue
        allowed = access & every & (~0 if os.path.isdir(path) else of_files)
        rule = struct.pack("<Qi", allowed, fd)
        check(libc.syscall(445, ruleset, 1, rule, 0), f"landlock_add_rule {path}")
        os.close(fd)
    check(libc.syscall(446, ruleset, 0), "landlock_restrict_self")
    os.close(ruleset)


def install_filter(program: bytes) -> None:
    program = program.replace(struct.pack("<I", PID_MARK), struct.pack("<I", os.getpid()))
    buffer = ctypes.create_string_buffer(program, len(program))
    prog = struct.pack("<HxxxxxxQ", len(program) // 8, ctypes.addressof(buffer))
    check(libc.prctl(22, 2, prog, 0, 0), "seccomp")  # PR_SET_SECCOMP, SECCOMP_MODE_FILTER


if __name__ == "__main__":
    main()
