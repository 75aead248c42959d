"""Answers for one policy: builds it from its bundle, hands it observations, sends back what it returns.

Runs inside the sandbox, in one process with the policy, which may change all of it: nothing here is trusted by the
worker. Frames: a request is `<u32 length, u8 kind, 3 pad, i64 argument>` and its payload, a reply is `<u32 length,
u8 tag, 3 pad>` and its payload; a question, then its answer, on two pipes. `evopolicy_worker.episodes.frames` is the
other end. Standard library and numpy only: the sandbox shows nothing else.
"""

import _random
import contextlib
import ctypes
import errno
import functools
import json
import marshal
import math
import os
import random
import struct
import sys
import traceback
import types
import warnings
from collections.abc import Callable
from importlib import machinery
from typing import Any, NoReturn

import numpy as np

REQUESTS, REPLIES = 3, 4
INIT, LOAD, RESET, ACT, FLUSH, END, COMPILE = 1, 2, 3, 4, 5, 6, 7
OK, INT, FLOAT, ARRAY, FLOATS, GENERIC, FAILED, FAULT = 0, 1, 2, 3, 4, 5, 6, 7
REQUEST_HEADER = struct.Struct("<IBxxxq")
REPLY_HEADER = struct.Struct("<IBxxx")
MAX_ACTION_DEPTH = 16
MAX_AXES = 16
VALUE_BYTES = 16
"""Bytes per value: an action may contain as many values as its byte limit divided by this."""
MAX_USED = 1 << 53
"""Largest size that is reported for an action."""
MAX_TEXT = 16_000
MAX_CODE_BYTES = 1 << 20

KINDS = dict.fromkeys((errno.ENOSPC, errno.EFBIG, errno.EDQUOT), "files")
KINDS |= {errno.EMFILE: "descriptors", errno.ENFILE: "descriptors", errno.EAGAIN: "processes"}
"""The limit that an error of the system reports."""
_REHEARSED = 32
"""Steps: more than the interpreter needs to adapt its code."""

libc = ctypes.CDLL(None, use_errno=True)
reset_floats = functools.partial(libc.fesetenv, ctypes.c_void_p(-1))
"""Resets to FE_DFL_ENV, since an allowed package may have changed it on import."""
flush_c = functools.partial(libc.fflush, None)
action_bytes = 16 << 10
"""Maximum size of one action, bytes; received with the policy."""
home = ""
"""The policy's own folder; received with the policy."""
programs: Any = None
"""The module `programs`, which the zygote loads."""

copy_words = ctypes.memmove
numpy_key = 0
"""Address of numpy's 624 words of state, which lie before their place; 0 where it is not known."""
PYTHON_KEY = object.__basicsize__ + 4
"""Of Python's generator: where its words begin, after their place."""

NONE = 0xFFFFFFFF
"""In place of a number of edges: there are none, and no links."""

Reader = Callable[[Any, Any], Any]
"""From the buffer (and where the next text begins, or the payload's length) to the observation or a part of it."""


def serve_policy(init: dict[str, Any]) -> NoReturn:
    """Builds the Policy and serves requests until the end is requested."""
    global action_bytes, home
    action_bytes, home = init["action_bytes"], init["home"]
    reset_floats()
    seed_generators(bytes.fromhex(init["seed"]))
    # The policy may have forged every later reply.
    reply(OK, b"")
    header = bytearray(REQUEST_HEADER.size)
    read_exactly(header)
    length, kind, _ = REQUEST_HEADER.unpack(header)
    path = init["home"] + "/system/policy.py"
    if kind == COMPILE:
        reply(OK, compiled(path))
        read_exactly(header)
        reply(OK, b"")
        os._exit(0)
    code = bytearray(length)
    read_exactly(code)
    # Before the policy can change the spaces, which are its own.
    reader = observation_reader(init["observed"], init["observations"] == "lists")
    stage = "import"
    try:
        module = imported_policy(path, code)
        program = programs.is_program(module)
        if not program and not isinstance(getattr(module, "Policy", None), type):
            raise ImportError("policy.py has no top-level class named Policy")
        stage = "init"
        spaces = init["obs_space"], init["action_space"]
        if program:
            policy = programs.Program(module, spaces, init["env_meta"], bytes.fromhex(init["seed"]))
        else:
            policy = module.Policy(*spaces, init["env_meta"])
    except BaseException as error:
        remark = ""
        with contextlib.suppress(BaseException):  # of a hostile exception, or without a file
            remark = programs.needs_newer(error, source_of(path))
        reply_failure(stage, error, remark)
        flush_output()
        os._exit(0)
    reply(OK, b"")
    answer(policy, reader)
    os._exit(0)


def compiled(path: str) -> bytes:
    """The file's code, for other processes; empty where compiling it fails or warns, which each of them then finds and
    reports itself. Runs none of it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            code = marshal.dumps(compile(source_of(path), path, "exec", dont_inherit=True))
    except BaseException:
        return b""
    return code if len(code) <= MAX_CODE_BYTES else b""


def imported_policy(path: str, code: bytes | bytearray) -> types.ModuleType:
    """The module of this file, from its code where that is given.

    Without the finder, which would prefer a folder or an extension module of that name beside the file.
    """
    module = types.ModuleType("policy")
    loader = machinery.SourceFileLoader("policy", path)
    spec = machinery.ModuleSpec("policy", loader, origin=path)
    spec.has_location = True
    module.__dict__.update(__file__=path, __spec__=spec, __loader__=loader, __package__="")
    sys.modules["policy"] = module
    program = marshal.loads(code) if code else compile(source_of(path), path, "exec", dont_inherit=True)
    exec(program, module.__dict__)
    return sys.modules["policy"]


def source_of(path: str) -> bytes:
    fd = os.open(path, os.O_RDONLY)
    source = os.read(fd, os.fstat(fd).st_size)
    os.close(fd)
    return source


def live_in(folder: str) -> None:
    """Sets home, temporary folder and module search path to this folder, which need not exist yet."""
    os.environ.pop("PWD", None)
    os.environ["HOME"] = folder
    os.environ["TMPDIR"] = folder + "/tmp"
    system = folder + "/system"
    sys.path.insert(0, system)
    sys.path_importer_cache[system] = machinery.FileFinder(
        system,
        (machinery.ExtensionFileLoader, machinery.EXTENSION_SUFFIXES),
        (machinery.SourceFileLoader, machinery.SOURCE_SUFFIXES),
        (machinery.SourcelessFileLoader, machinery.BYTECODE_SUFFIXES),
    )


def rehearse() -> None:
    """Does once, before any policy exists, what every policy's process does.

    The interpreter adapts its code and fills its tables while it runs. It writes to memory that processes share until
    then, and each policy's process would have its own copies made.
    """
    global REQUESTS, REPLIES
    find_numpy_key()
    space = {"type": "Box", "shape": (2,), "dtype": "float64"}
    usual, pipes = (REQUESTS, REPLIES), (os.pipe(), os.pipe())
    REQUESTS, REPLIES = pipes[0][0], pipes[1][1]
    act = REQUEST_HEADER.pack(16, ACT, 0) + bytes(16)
    for action in (0, 0.0, [0.0, 0.0], np.zeros(2), np.float32(0.0), np.int64(0)):
        seed_generators(bytes(range(16)))
        exec(compile("class Policy:\n    def reset(self, n):\n        pass\n", "policy.py", "exec"), {})
        begin, end = REQUEST_HEADER.pack(0, RESET, 0), REQUEST_HEADER.pack(0, END, 0)
        questions = iter((begin, *[act] * _REHEARSED, end))

        def act_once(answer: Any = action, questions: Any = questions) -> Any:
            os.write(pipes[0][1], next(questions))
            return answer

        act_once()
        policy = types.SimpleNamespace(
            reset=lambda index, ask=act_once: ask(), act=lambda obs, ask=act_once: ask()
        )
        answer(policy, observation_reader(space, False))
        os.read(pipes[1][0], 65536)
    REQUESTS, REPLIES = usual
    for fd in (*pipes[0], *pipes[1]):
        os.close(fd)
    reply_heads.clear()


def seed_generators(seed: bytes) -> None:
    random.seed(seed)
    if not (numpy_key and copy_key(seed)):
        np.random.seed(list(struct.unpack("<4I", seed[:16])))
    # Sources of system entropy in numpy: unseeded default_rng(), SeedSequence(), bit generators.
    entropy = random.Random(seed + b"numpy")
    vars(np.random.bit_generator)["randbits"] = entropy.getrandbits


def copy_key(seed: bytes) -> bool:
    """Sets numpy's generator as `np.random.seed` with the seed's four words does; False where they end with zeros,
    which Python leaves out.

    Python's generator, made from the same words, has the same 624 words of state. Passed on as Python's numbers, they
    would touch ten times as much memory, which each policy's process has to copy. For a generator that has drawn
    nothing yet.
    """
    number = int.from_bytes(seed[:16], "little")
    if number >> 96:
        generator = _random.Random(number)
        copy_words(numpy_key, id(generator) + PYTHON_KEY, 4 * 624)
    return bool(number >> 96)


def find_numpy_key() -> None:
    """Finds where numpy's generator has its words; leaves it unknown where the two are not laid out as usual."""
    global numpy_key
    seed = bytes(range(16))
    np.random.seed(list(struct.unpack("<4I", seed)))
    wanted = np.random.standard_normal(999).tolist()
    np.random.seed(0)
    numpy_key = vars(np.random)["get_bit_generator"]().ctypes.state_address
    copy_key(seed)
    if np.random.standard_normal(999).tolist() != wanted:
        numpy_key = 0
    np.random.seed(0)


def answer(policy: Any, reader: tuple[Callable[[], Any], Reader]) -> None:
    """Serves requests until the end is requested."""
    make_buffer, observation = reader
    header = bytearray(REQUEST_HEADER.size)
    unpack = REQUEST_HEADER.unpack
    readv, write = os.readv, os.write
    while True:
        body = make_buffer()
        n = readv(REQUESTS, (header, body))
        if not n:
            os._exit(0)
        if n < 16:
            read_exactly(memoryview(header)[n:])
            n = 16
        length, kind, argument = unpack(header)
        if n < 16 + length:
            body = complete(body, n - 16, length)
        if kind == ACT:
            try:
                data = encoded(policy.act(observation(body, length)))
            except BaseException as error:
                reply_failure("act", error)
            else:
                n = write(REPLIES, data)
                while n < len(data):
                    n += write(REPLIES, data[n:])
        elif kind == RESET:
            try:
                policy.reset(argument)
            except BaseException as error:
                reply_failure("reset", error)
            else:
                reply(OK, b"")
        else:
            flush_output()
            reply(OK, b"")
            if kind == END:
                return


def read_exactly(buffer: bytearray | memoryview) -> None:
    view = memoryview(buffer)
    while len(view):
        n = os.readv(REQUESTS, [view])
        if not n:
            os._exit(0)
        view = view[n:]


def complete(body: Any, have: int, length: int) -> Any:
    """`body` with the rest of a payload of which `have` bytes are in it; a larger buffer when it does not fit."""
    raw = memoryview(body if isinstance(body, bytearray) else body.reshape(-1).view(np.uint8))
    if len(raw) < length:
        body = bytearray(length)
        body[:have] = raw[:have]
        raw = memoryview(body)
    read_exactly(raw[have:length])
    return body


# Observations: fixed arrays and ints first, each on a multiple of 8 bytes, then texts with their lengths.


def observation_reader(space: dict[str, Any], as_lists: bool) -> tuple[Callable[[], Any], Reader]:
    """Two functions: a fresh buffer to read a payload into, and from buffer and length to the observation."""
    kind = space["type"]
    if kind in ("Box", "Image") and not as_lists:
        shape, dtype = tuple(space["shape"]), np.dtype(space["dtype"])
        empty = np.empty
        return (lambda: empty(shape, dtype)), (lambda body, length: body)
    fixed = [0]
    build = part_reader(space, fixed, as_lists)
    start = fixed[0]

    def observation(body: Any, length: int) -> Any:
        return build(body, [start])

    return (lambda: bytearray(start + 512)), observation


def part_reader(space: dict[str, Any], fixed: list[int] | None, as_lists: bool) -> Reader:
    """`fixed`: the bytes of the fixed arrays and ints so far; None inside a value whose form the space leaves open,
    where counts stand before what they count, and nothing is padded."""
    kind = space["type"]
    row = list if as_lists else tuple
    if kind == "Dict":
        named = {key: part_reader(part, fixed, as_lists) for key, part in space["spaces"].items()}
        return lambda body, at: {key: read(body, at) for key, read in named.items()}
    if kind == "Tuple":
        parts = [part_reader(part, fixed, as_lists) for part in space["spaces"]]
        return lambda body, at: row([read(body, at) for read in parts])
    if kind == "Text":
        return read_text
    if kind == "Sequence":
        if space["stacked"]:
            shape, dtype = array_of(space["space"])
            return lambda body, at: take_array(body, at, (take_count(body, at), *shape), dtype, as_lists)
        item = part_reader(space["space"], None, as_lists)
        return lambda body, at: row([item(body, at) for _ in range(take_count(body, at))])
    if kind == "OneOf":
        choices = [part_reader(part, None, as_lists) for part in space["spaces"]]
        return lambda body, at: row((index := take_count(body, at), choices[index](body, at)))
    if kind == "Graph":
        return graph_reader(space, as_lists)
    shape, dtype = array_of(space)
    if fixed is None:
        # Of one number, `tolist` makes a number of Python.
        return lambda body, at: take_array(body, at, shape, dtype, as_lists or kind == "Discrete")
    offset = fixed[0]
    count = math.prod(shape)
    fixed[0] += -(-count * dtype.itemsize // 8) * 8
    if kind == "Discrete":
        return lambda body, at: int.from_bytes(body[offset : offset + 8], "little", signed=True)
    frombuffer = np.frombuffer
    if as_lists:
        return lambda body, at: frombuffer(body, dtype, count, offset).reshape(shape).tolist()
    return lambda body, at: frombuffer(body, dtype, count, offset).reshape(shape)


def array_of(space: dict[str, Any]) -> tuple[tuple[int, ...], Any]:
    """Shape and dtype of the array that a value of this space is; () and int64 for Discrete."""
    kind = space["type"]
    if kind in ("Box", "Image"):
        return tuple(space["shape"]), np.dtype(space["dtype"])
    if kind == "MultiBinary":
        return tuple(np.atleast_1d(space["n"]).tolist()), np.dtype(np.int8)
    return np.shape(space.get("nvec", 0)), np.dtype(np.int64)


def graph_reader(space: dict[str, Any], as_lists: bool) -> Reader:
    node_shape, node_dtype = array_of(space["node_space"])
    edge_shape, edge_dtype = array_of(space["edge_space"] or space["node_space"])

    def graph(body: Any, at: Any) -> Any:
        n, m = take_count(body, at), take_count(body, at)
        nodes = take_array(body, at, (n, *node_shape), node_dtype, as_lists)
        if m == NONE:
            return {"nodes": nodes, "edges": None, "edge_links": None}
        edges = take_array(body, at, (m, *edge_shape), edge_dtype, as_lists)
        links = take_array(body, at, (m, 2), np.dtype(np.int64), as_lists)
        return {"nodes": nodes, "edges": edges, "edge_links": links}

    return graph


def take_count(body: Any, at: Any) -> int:
    start = at[0]
    at[0] = start + 4
    return int.from_bytes(body[start : start + 4], "little")


def take_array(body: Any, at: Any, shape: tuple[int, ...], dtype: Any, as_lists: bool) -> Any:
    start = at[0]
    count = math.prod(shape)
    at[0] = start + count * dtype.itemsize
    # A copy, since a part in the middle of the buffer may not be aligned.
    array = np.frombuffer(body, dtype, count, start).reshape(shape).copy()
    return array.tolist() if as_lists else array


def read_text(body: Any, at: Any) -> str:
    length = take_count(body, at)
    at[0] += length
    return str(body[at[0] - length : at[0]], "utf-8", "surrogatepass")


# Actions.


class TooLargeError(ValueError):
    """An action of more bytes than it may have: how many, as far as they were counted."""

    # A traceback, which the agent reads, then shows no module of ours.
    __module__ = "builtins"

    def __init__(self, message: str, used: int) -> None:
        super().__init__(message)
        self.used = used


def encoded(action: Any) -> bytes:
    """The reply frame for what `act` returned."""
    kind = type(action)
    if kind is int and -(1 << 63) <= action < 1 << 63:
        return struct.pack("<IBxxxq", 8, INT, action)
    if kind is np.ndarray and action.dtype.kind in "biuf" and action.itemsize <= 8:
        form = action.dtype, action.shape
        head = reply_heads.get(form)
        if head is not None:
            return head + bytes(action.tobytes())
        check_size(action.nbytes)
        if action.size > action_bytes // VALUE_BYTES or not action.size:
            check_values(numbers_of(action))
        data = array_data(action)
        frame = REPLY_HEADER.pack(len(data), ARRAY) + data
        if action.dtype.byteorder != ">":
            reply_heads[form] = frame[: len(frame) - action.nbytes]
        return frame
    if isinstance(action, np.integer) and kind is not np.uint64:
        return struct.pack("<IBxxxq", 8, INT, int(action))
    if kind is float:
        return struct.pack("<IBxxxd", 8, FLOAT, action)
    if kind is list and len(action) <= action_bytes // VALUE_BYTES and set(map(type, action)) == {float}:
        return struct.pack(f"<IBxxx{len(action)}d", 8 * len(action), FLOATS, *action)
    out = bytearray()
    n = pack(action, out, 0)
    check_size(len(out))
    check_values(n)
    return REPLY_HEADER.pack(len(out), GENERIC) + bytes(out)


def check_size(n: int) -> None:
    if n > action_bytes:
        raise TooLargeError(f"the action has {n:,} bytes; {action_bytes:,} are the limit", n)


def check_values(n: int) -> None:
    if n > action_bytes // VALUE_BYTES:
        how = f"the action holds {n:,} values; {action_bytes // VALUE_BYTES:,} are the limit"
        raise TooLargeError(how, min(n * VALUE_BYTES, MAX_USED))


def numbers_of(array: Any) -> int:
    """How many numbers an array is written as, or innermost lists where it holds none."""
    return int(array.size) or math.prod(max(1, n) for n in array.shape)


reply_heads: dict[Any, bytes] = {}
"""By dtype and shape, the bytes of a reply before the numbers of an array that may be sent."""


def array_data(array: Any) -> bytes:
    if array.ndim > MAX_AXES:
        raise ValueError(f"the action has an array of {array.ndim} axes; {MAX_AXES} are the limit")
    array = array.astype(array.dtype.newbyteorder("<"), copy=False)
    head = struct.pack(f"<4sI{array.ndim}I", array.dtype.str.encode(), array.ndim, *array.shape)
    return head + bytes(array.tobytes())


def pack(value: Any, out: bytearray, depth: int) -> int:
    """Appends `value` as msgpack, or its type's name where it has no form. Returns its number of values."""
    n = 1
    if depth > MAX_ACTION_DEPTH:
        raise ValueError(f"the action nests deeper than {MAX_ACTION_DEPTH}")
    if len(out) > action_bytes:
        raise TooLargeError(f"the action has more than {action_bytes:,} bytes, which are the limit", len(out))
    if isinstance(value, np.generic):
        value = np.asarray(value) if value.dtype.kind == "f" else value.item()
    if value is None:
        out.append(0xC0)
    elif value is True or value is False:
        out.append(0xC3 if value else 0xC2)
    elif isinstance(value, int):
        if -(1 << 63) <= value < 1 << 63:
            out += struct.pack(">Bq", 0xD3, value)
        elif value.bit_length() <= 4096:
            extension(2, str(int(value)).encode(), out)
        else:
            raise ValueError(f"the action holds an integer of {value.bit_length()} bits")
    elif isinstance(value, float):
        out += struct.pack(">Bd", 0xCB, value)
    elif isinstance(value, str):
        text = value.encode("utf-8", "backslashreplace")
        out += struct.pack(">BI", 0xDB, len(text)) + text
    elif isinstance(value, bytes | bytearray):
        out += struct.pack(">BI", 0xC6, len(value)) + bytes(value)
    elif isinstance(value, list | tuple):
        out += struct.pack(">BI", 0xDD, len(value))
        for item in value:
            n += pack(item, out, depth + 1)
    elif isinstance(value, dict):
        out += struct.pack(">BI", 0xDF, len(value))
        for key, item in value.items():
            n += pack(str(key), out, depth + 1)
            n += pack(item, out, depth + 1)
    elif hasattr(value, "__array__"):
        array = np.asarray(value)
        if array.dtype.kind == "f" and array.itemsize > 8:
            array = array.astype(np.float64)
        if array.dtype.kind in "biuf":
            n = numbers_of(array)
            check_values(n)
            extension(1, array_data(array), out)
        else:
            n += pack(array.tolist(), out, depth + 1)
    else:
        pack(f"<{type(value).__name__}>", out, depth)
    return n


def extension(code: int, data: bytes, out: bytearray) -> None:
    out += struct.pack(">BIb", 0xC9, len(data), code) + data


# Replies.


def reply(tag: int, payload: bytes) -> None:
    data = REPLY_HEADER.pack(len(payload), tag) + payload
    while data:
        data = data[os.write(REPLIES, data) :]


def reply_failure(stage: str, error: BaseException, remark: str = "") -> None:
    """Reports an exception of the policy's code, which may forge its text, but only of its own failure."""
    kind, text, message, missing = None, "", "an exception that cannot be shown", None
    # A hostile exception may raise when it is read; then the parts read so far are reported.
    with contextlib.suppress(BaseException):
        frames = error.__traceback__
        while frames is not None and frames.tb_frame.f_code.co_filename in (__file__, programs.__file__):
            frames = frames.tb_next
        kind = kind_of(error)
        message = "".join(traceback.format_exception_only(type(error), error)).strip().rpartition("\n")[2]
        if isinstance(error, SyntaxError):
            # Python shows its line above that one.
            message = f"{type(error).__name__}: {error}"
        text = "".join(traceback.format_exception(type(error), error, frames))
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
    report = {
        "stage": stage,
        "kind": kind,
        "message": sendable(message[:2000] + remark),
        "traceback": sendable(text[-MAX_TEXT:]),
        "missing": sendable(missing[:200]) if type(missing) is str else None,
        "used": min(error.used, 1 << 53) if type(error) is TooLargeError else None,
    }
    reply(FAILED, json.dumps(report).encode())


def sendable(text: str) -> str:
    """Half surrogates, which have no form in UTF-8, as Python writes them."""
    return text.encode("utf-8", "backslashreplace").decode()


def kind_of(error: BaseException | None) -> str | None:
    """Which limit an exception tells of, if any."""
    for _ in range(10):
        if error is None:
            break
        if type(error) is TooLargeError:
            return "action"
        if isinstance(error, MemoryError):
            return "memory"
        if isinstance(error, OSError) and error.errno in KINDS:
            full = error.errno == errno.ENOSPC and no_file_left()
            return "inodes" if full else KINDS[error.errno]
        if isinstance(error, RuntimeError) and "start new thread" in str(error):
            return "processes"
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return None


def no_file_left() -> bool:
    """Whether no file can be made in the policy's home. A link takes none of its bytes."""
    path = f"{home}/tmp/evopolicy-{random.getrandbits(64):x}"
    try:
        os.symlink("-", path)
        os.unlink(path)
    except OSError as error:
        return error.errno == errno.ENOSPC
    return False


def flush_output() -> None:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(BaseException):
            stream.flush()
    flush_c()
