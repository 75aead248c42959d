"""The zygote inside the sandbox: forks a process per policy, which seals itself before it reads the bundle.

- The zygote never reads a bundle: hostile code imported there would control every later episode. It has numpy imported.
- Each policy's process is pid 1 of its own pid namespace, with its own mounts. It then drops all rights: capabilities,
  new privileges, files outside (Landlock), system calls (the filter), limits.
- When started as root, it first becomes an unprivileged user of a user namespace.

| process | state | event | next |
|---|---|---|---|
| zygote | starting | the configuration arrives | as root: a fork in namespaces of its own goes on, and this one waits |
| | | all is imported and frozen | serving, after `{"ready": true}` |
| | | something fails | ended, after `{"error": ...}` |
| | serving | a process is asked for | serving; its fork is a policy's process |
| | | the end of a process is asked about | serving; sends how it ended |
| | | `q`, or the worker's socket is closed | ended |
| policy's | born | its pipes are handed out | unsealed; if that fails ended with 71, after the error |
| | unsealed | INIT: bundle written, rights given up | sealed; if that fails ended with 71, after FAULT |
| | sealed | the policy is imported and asked (`policy_server`) | ended, by END, by itself, or by a limit |

Standard library and numpy only: the sandbox shows nothing else.
"""

import collections
import contextlib
import ctypes
import functools
import gc
import importlib
import importlib.util
import io
import itertools
import json
import operator
import os
import resource
import select
import selectors
import signal
import socket
import struct
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NoReturn

CLONE_NEWNS, CLONE_NEWIPC, CLONE_NEWUSER, CLONE_NEWPID = 0x00020000, 0x08000000, 0x10000000, 0x20000000
MS_RDONLY, MS_NOSUID, MS_NODEV, MS_REMOUNT, MS_NOATIME, MS_BIND, MS_REC = 1, 2, 4, 32, 1024, 4096, 16384
MS_PRIVATE = 1 << 18
HOME_FLAGS = MS_NOSUID | MS_NODEV | MS_NOATIME
WAITID = 247 if os.uname().machine == "x86_64" else 95
P_PIDFD, WEXITED, MADV_DONTFORK, MADV_COLLAPSE = 3, 4, 10, 25
SIGINFO_BYTES, REPORT_BYTES = 128, 128 + 144
"""Of `siginfo_t`; with `struct rusage` after it."""
N_PIPES = 4
ARENA, HUGE_PAGE, HEAP_ROOM = 1 << 20, 2 << 20, 256 << 20
MAP_FIXED_NOREPLACE = 0x100000
NOBODY = 65534
PID_MARK = 0x7FFFABCD
MAX_TEXT = 16_000

RIGHTS = struct.Struct(f"@Nii{N_PIPES + 1}i")
"""`struct cmsghdr` with descriptors."""

libc = ctypes.CDLL(None, use_errno=True)
for _name in ("capset", "mount", "prctl", "sendmsg", "syscall", "unshare"):
    getattr(libc, _name)  # looked up here, once for all policies
ENVELOPE = ctypes.create_string_buffer(-(-RIGHTS.size // 8) * 8)
_WORD = ctypes.create_string_buffer(b" ", 1)
_PIECES = (ctypes.c_size_t * 2)(ctypes.addressof(_WORD), len(_WORD))
LETTER = (ctypes.c_size_t * 7)(
    0, 0, ctypes.addressof(_PIECES), 1, ctypes.addressof(ENVELOPE), len(ENVELOPE), 0
)
"""`struct msghdr` of one byte with the envelope. A `socket` asks the kernel for its kind first, which touches many
objects."""
policy_server: Any = None
"""The module `policy_server`: imports numpy, so not before the path to it is known."""
scan_json = vars(json.JSONDecoder())["scan_once"]


def check(result: int, call: str) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{call}: {os.strerror(number)}")
    return result


def main() -> None:
    libc.prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    control = socket.socket(fileno=int(sys.argv[1]))
    config = json.loads(control.recv(1 << 18))
    # It was for this program and its libraries, which are loaded by now.
    os.environ.pop("LD_BIND_NOW", None)
    try:
        if config["become_nobody"]:
            enter_user_namespace(control)
        with huge_pages():
            sys.path.append(config["packages"])
            warm(config["warm"])
            streams = output_streams()
            if config["namespaces"]:
                check(libc.mount(b"none", b"/", None, MS_REC | MS_PRIVATE, None), "private mounts")
                for device in config["devices"]:
                    protect(device)
                module("files").take_over(config["folders"], config["libraries"], config["place"])
                # The same for all policies, and it costs each of them a copy of the memory that it touches.
                policy_server.live_in(config["home"])
            program = bytes.fromhex(config["filter"])
            # In a namespace of its own, each has the same number.
            config["filter"] = filter_of(program, 1) if config["namespaces"] else program
            gc.collect()
        gc.freeze()
    except BaseException as error:
        control.send(json.dumps({"error": f"{type(error).__name__}: {error}"}).encode())
        if isinstance(error, OSError):
            sys.exit(1)  # the machine refuses, and the error says it all
        raise
    # Without the object, for which Python warns in each policy's process that nobody has closed it.
    zygote(control.detach(), config["namespaces"], lambda worker: policy_process(config, worker, streams))


def enter_user_namespace(control: socket.socket) -> None:
    """When started as root: continues as an unprivileged user, as pid 1 of namespaces that this user owns."""
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
    """Read-only, which leaves a device's data as it is: who may write could set its times, for all the machine to
    see."""
    # These may not be taken away in a namespace, so they are named again; ST_ and MS_ are the same numbers.
    flags = os.statvfs(device).f_flag & (os.ST_NOSUID | os.ST_NODEV | os.ST_NOEXEC)
    flags |= MS_REMOUNT | MS_BIND | MS_RDONLY
    check(libc.mount(None, device.encode(), None, flags, None), f"protect {device}")


def module(name: str) -> Any:
    """Imports one of our modules beside this file. Not by the path, since a bundle may have a module of that name."""
    path = os.path.join(os.path.dirname(__file__), f"{name}.py")
    spec = importlib.util.spec_from_file_location(f"_{name}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def warm(modules: list[str]) -> None:
    """Imports what every policy may use, so that children share it."""
    global policy_server
    policy_server = module("policy_server")
    policy_server.programs = module("programs")
    np = policy_server.np
    standard = ("math", "collections", "dataclasses", "typing", "heapq", "itertools", "functools", "pathlib")
    for name in ("numpy.random", "numpy.linalg", "numpy.fft", *modules, *standard):
        importlib.import_module(name)
    np.random.default_rng(0).standard_normal(2)
    np.dot(np.eye(3), np.ones(3))
    # The filter refuses `epoll`, whose watches are kernel memory that no limit counts.
    vars(selectors)["DefaultSelector"] = selectors.PollSelector
    traceback.format_exception(ValueError("warm"))
    policy_server.rehearse()


class Arenas(ctypes.Structure):
    """`PyObjectArenaAllocator`: where Python gets the memory of small objects, 1 MiB at a time."""

    _fields_ = (("context", ctypes.c_void_p), ("allocate", ctypes.c_void_p), ("free", ctypes.c_void_p))


@contextlib.contextmanager
def huge_pages() -> Iterator[None]:
    """Puts what is allocated inside into huge pages, which a fork and the end of a process handle as one.

    Python's arenas usually lie between libraries, where no huge page fits. Here they extend the C library's heap. A
    page that a policy's process writes to is copied alone. Without effect on kernels before 6.1, with other C
    libraries, from Python 3.14 on, and where the heap cannot grow by `HEAP_ROOM`.
    """
    if not hasattr(libc, "gnu_get_libc_version") or sys.version_info >= (3, 14) or not heap_can_grow():
        yield
        return
    begin = libc.sbrk(ctypes.c_long(0))
    usual = Arenas()
    ctypes.pythonapi.PyObject_GetArenaAllocator(ctypes.byref(usual))
    extend = ctypes.cast(libc.sbrk, ctypes.c_void_p)
    # Called with the context and the size, of which `sbrk` reads the first.
    ctypes.pythonapi.PyObject_SetArenaAllocator(ctypes.byref(Arenas(ARENA, extend, usual.free)))
    yield
    ctypes.pythonapi.PyObject_SetArenaAllocator(ctypes.byref(usual))
    # From the heap's beginning on. Where it is not mapped, or the kernel has no huge page, nothing changes.
    end = libc.sbrk(ctypes.c_long(0))
    for at in range(begin // HUGE_PAGE * HUGE_PAGE - HUGE_PAGE, end - HUGE_PAGE + 1, HUGE_PAGE):
        libc.madvise(ctypes.c_void_p(at), ctypes.c_size_t(HUGE_PAGE), MADV_COLLAPSE)


def heap_can_grow() -> bool:
    """Whether there is room behind the C library's heap. Where there is none, `sbrk` returns -1, which is not 0: Python
    would take it for an arena's address."""
    libc.sbrk.restype = libc.mmap.restype = ctypes.c_void_p
    end, size = ctypes.c_void_p(libc.sbrk(ctypes.c_long(0))), ctypes.c_size_t(HEAP_ROOM)
    # Not by `sbrk`: taking it back could take what the C library has allocated meanwhile.
    mapped = libc.mmap(end, size, 3, 0x22 | MAP_FIXED_NOREPLACE, -1, ctypes.c_long(0))
    libc.munmap(ctypes.c_void_p(mapped), size)
    return bool(mapped == end.value)


def zygote(control: int, namespaces: bool, then: Callable[[int], None]) -> NoReturn:
    """Serves the worker, on the socket `control`, until it is told to end. In a fork for each policy it calls `then`
    with a socket to the worker.

    A policy can read all memory that it was forked with. So this process must learn nothing of the policies before, nor
    count them. It runs no Python between two forks, whose interpreter counts what it does: the same calls in a circle,
    with the same arguments. How a policy ended lies in a page that children do not inherit, from where it is sent.

    A request of one byte asks how a process ended (its pidfd, a socket for the answer), one of two asks for a process
    (the socket that is returned) or, beginning with `q`, for the end. A closed socket asks for the end too:
    the kernel's kill of a child whose parent dies can come before the child has asked for it.
    """
    page = unshared_page()
    how, usage = ctypes.c_void_p(page), ctypes.c_void_p(page + SIGINFO_BYTES)
    asked, fds = ctypes.create_string_buffer(2), ctypes.create_string_buffer(24)
    pieces = (ctypes.c_size_t * 2)(ctypes.addressof(asked), len(asked))
    # struct msghdr: no name, one piece, two descriptors, flags
    message = (ctypes.c_size_t * 7)(0, 0, ctypes.addressof(pieces), 1, ctypes.addressof(fds), len(fds), 0)
    # struct pollfd, twice: two are ready only where the other side is closed.
    watched = struct.pack("ihhihh", control, select.POLLIN, 0, control, select.POLLRDHUP, 0)
    polled = ctypes.create_string_buffer(watched, len(watched))
    calls = ctypes.PyDLL(None)
    myself = os.pidfd_open(os.getpid())
    # The lowest numbers that are free, which descriptors that arrive get.
    first, second = os.dup(0), os.dup(0)
    os.close(first)
    os.close(second)

    def step(name: str, result: Any, *arguments: Any) -> Any:
        function = calls[name]
        function.restype = result
        return functools.partial(function, *arguments)

    def around(steps: Iterable[Any]) -> Any:
        return functools.partial(next, map(operator.call, itertools.cycle(steps)))

    ends = around(
        (
            # The end, unless a request takes its place.
            step("memset", None, asked, ord("q"), 2),
            step("poll", ctypes.c_int, polled, 2, -1),
            # It begins again after a request for a process too. Then these descriptors are closed, and nothing happens.
            step("recvmsg", ctypes.c_ssize_t, control, message, 0),
            step("syscall", None, WAITID, P_PIDFD, first, how, WEXITED, usage),
            step("send", None, second, how, ctypes.c_size_t(REPORT_BYTES), 0),
            step("close", None, first),
            step("close", None, second),
        )
    )
    until_two_bytes = map(operator.call, itertools.repeat(functools.partial(iter, ends, 2)))
    # The search for an object that is not among the answers asks for all of them.
    gone_through = map(operator.contains, until_two_bytes, itertools.repeat(object()))
    circle = (
        functools.partial(next, map(operator.not_, gone_through)),
        # 0, here and in the child, ends the circle.
        step("memcmp", ctypes.c_int, asked, b"q", 1),
        *([step("unshare", None, CLONE_NEWPID)] if namespaces else []),
        step("fork", ctypes.c_int),
        # Else the next child would be born into the namespace of this one.
        *([step("setns", None, myself, CLONE_NEWPID)] if namespaces else []),
        step("close", None, first),
        # A number in place of the child's, which counts the policies.
        step("labs", ctypes.c_long, ctypes.c_long(1 << 40)),
    )
    os.write(control, b'{"ready": true}')
    rounds = around(circle)
    collections.deque(iter(rounds, 0), maxlen=0)
    if asked.raw[:1] == b"q":
        os._exit(0)
    # Only its forks reach this line. They must never continue as the zygote. They do not return from here, because
    # releasing the objects of this function would copy their memory in each of them.
    try:
        then(first)
    finally:
        os._exit(70)


def unshared_page() -> int:
    """Address of memory that no child inherits."""
    libc.mmap.restype = ctypes.c_void_p
    page = libc.mmap(None, ctypes.c_size_t(4096), 3, 0x22, -1, ctypes.c_long(0))
    check(libc.madvise(ctypes.c_void_p(page), ctypes.c_size_t(4096), MADV_DONTFORK), "madvise")
    return int(page)


# One policy's process.


def policy_process(config: dict[str, Any], worker: int, streams: tuple[Any, Any]) -> None:
    """`worker`: a socket on which the worker waits for this process and its pipes. `streams`: text on 1 and 2."""
    libc.prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    try:
        home = None
        if config["namespaces"]:
            home = config["home"]
            if os.getpid() != 1:
                raise OSError("it has no process namespace of its own")
            check(libc.unshare(CLONE_NEWNS | CLONE_NEWIPC), "unshare mounts, ipc")
            mount_home(home, config["own_tmp"])
        hand_out_pipes(worker, home)
        sys.stdout, sys.stderr = streams
    except BaseException as error:
        os.write(worker, f"{type(error).__name__}: {error}".encode()[:MAX_TEXT])
        os._exit(71)
    try:
        header = bytearray(policy_server.REQUEST_HEADER.size)
        policy_server.read_exactly(header)
        length, kind, json_length = policy_server.REQUEST_HEADER.unpack(header)
        body = bytearray(length)
        policy_server.read_exactly(body)
        if kind != policy_server.INIT:
            raise OSError("the first request is not INIT")
        init, _ = scan_json(str(body[:json_length], "utf-8"), 0)
        if home is not None:
            limit_home(home, init["home_bytes"], init["home_inodes"])
        else:
            for folder in ("/tmp", "/system"):
                os.makedirs(init["home"] + folder, exist_ok=True)
            policy_server.live_in(init["home"])
        write_bundle(init, memoryview(body)[json_length:])
        seal(config, init)
    except BaseException as error:
        policy_server.reply(policy_server.FAULT, f"{type(error).__name__}: {error}".encode()[:MAX_TEXT])
        os._exit(71)
    del body, header, config
    policy_server.serve_policy(init)


def hand_out_pipes(worker: int, home: str | None) -> None:
    """Requests on 3, replies on 4, output on 1 and 2, an empty input of its own on 0; everything else closed.

    The worker gets this process's pidfd and the other ends.
    """
    pipes = [os.pipe() if home is None else private_pipe(f"{home}/pipe") for _ in range(N_PIPES)]
    (requests, to_requests), (from_replies, replies), (from_stdout, stdout), (from_stderr, stderr) = pipes
    others = os.pidfd_open(os.getpid()), to_requests, from_replies, from_stdout, from_stderr
    RIGHTS.pack_into(ENVELOPE, 0, RIGHTS.size, socket.SOL_SOCKET, socket.SCM_RIGHTS, *others)
    check(libc.sendmsg(worker, LETTER, 0), "sendmsg")
    high = [os.dup2(fd, 100 + k) for k, fd in enumerate((requests, replies, stdout, stderr))]
    # Not the zygote's: the flags of an open file are the same for all who share it, and would outlive the episode.
    os.dup2(os.open("/dev/null", os.O_RDWR), 0)
    for fd, target in zip(high, (policy_server.REQUESTS, policy_server.REPLIES, 1, 2), strict=True):
        os.dup2(fd, target)
    os.closerange(5, 1024)


def private_pipe(path: str) -> tuple[int, int]:
    """Both ends of a pipe that is a file of the policy's own file system.

    Those of `pipe` are numbered through for the whole machine, and `fstat` shows the number.
    """
    os.mkfifo(path)
    read = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    write = os.open(path, os.O_WRONLY)
    os.unlink(path)
    os.set_blocking(read, True)
    return read, write


def output_streams() -> tuple[Any, Any]:
    """Text on 1 and 2 that is written line by line, so that lines printed before a policy is killed are kept.

    Made while both are a pipe, as they will be in the policies' processes: a stream remembers whether its file has a
    position.
    """
    pipe = os.pipe()
    before = os.dup(1), os.dup(2)
    for fd in (1, 2):
        os.dup2(pipe[1], fd)
    raw = [io.BufferedWriter(io.FileIO(fd, "w", closefd=False)) for fd in (1, 2)]
    options: dict[str, Any] = {"encoding": "utf-8", "errors": "backslashreplace", "line_buffering": True}
    streams = io.TextIOWrapper(raw[0], **options), io.TextIOWrapper(raw[1], **options)
    for fd, own in zip((1, 2), before, strict=True):
        os.dup2(own, fd)
    for fd in (*pipe, *before):
        os.close(fd)
    return streams


def mount_home(home: str, own_tmp: bool) -> None:
    """A file system of the policy's own, for its copy of `system/` and for /tmp."""
    check(libc.mount(b"home", home.encode(), b"tmpfs", HOME_FLAGS, b"mode=0700"), "mount home")
    os.mkdir(f"{home}/tmp")
    os.mkdir(f"{home}/system")
    if own_tmp:
        check(libc.mount(f"{home}/tmp".encode(), b"/tmp", None, MS_BIND, None), "bind /tmp")


def limit_home(home: str, n_bytes: int, n_files: int) -> None:
    """Limits its size. The pipes are files of it too."""
    options = f"size={n_bytes},nr_inodes={n_files + N_PIPES}".encode()
    check(libc.mount(None, home.encode(), None, HOME_FLAGS | MS_REMOUNT, options), "limit home")


def write_bundle(init: dict[str, Any], data: memoryview) -> None:
    os.chdir(init["home"] + "/system")
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
    """Gives up rights of this process, for good."""
    if config["limits"]:
        for name, value in init["limits"].items():
            kind = getattr(resource, name)
            _, most = resource.getrlimit(kind)
            if most != resource.RLIM_INFINITY:
                # Rights that this machine grants to nobody are not requested.
                value = min(value, most)
            resource.setrlimit(kind, (value, value))
    if config["seals"]:
        drop_capabilities()
        check(libc.prctl(38, 1, 0, 0, 0), "no_new_privs")
        if config["landlock"]:
            landlock(config["landlock"], init["home"])
        program = config["filter"]
        prog, _buffer = filter_of(program, os.getpid()) if isinstance(program, bytes) else program
        check(libc.prctl(22, 2, prog, 0, 0), "seccomp")  # PR_SET_SECCOMP, SECCOMP_MODE_FILTER


def drop_capabilities() -> None:
    libc.prctl(47, 4, 0, 0, 0)  # PR_CAP_AMBIENT_CLEAR_ALL
    header = struct.pack("<Ii", 0x20080522, 0)
    check(libc.capset(header, bytes(24)), "capset")


def landlock(rules: dict[str, list[str]], home: str) -> None:
    """Restricts opening files to the given paths; if the kernel supports it, also TCP, abstract sockets and signals."""
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


def filter_of(program: bytes, pid: int) -> tuple[bytes, Any]:
    """`struct sock_fprog` of the filter for the process of that number, and the memory that it points to."""
    program = program.replace(struct.pack("<I", PID_MARK), struct.pack("<I", pid))
    buffer = ctypes.create_string_buffer(program, len(program))
    return struct.pack("<HxxxxxxQ", len(program) // 8, ctypes.addressof(buffer)), buffer


if __name__ == "__main__":
    main()
