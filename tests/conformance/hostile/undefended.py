"""A policy server without any defence: the policy lives in the environment's own process, and its results are pickles
on a pipe.

What a breaker does to it is what it is worth; `harmed` tells. Run as a program, with descriptors 3 (a byte for each
step) and 4 (results: length and pickle), it plays the `policy.py` of the folder that it is given. The results are
opened in a process of their own, as one that believes them would open them.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import resource
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

N_STEPS = 60
MAX_OUTPUT = 65536
MAX_FILE = 64 << 20
COMMANDS, REPLIES = 3, 4
_LENGTH = struct.Struct("<I")
_TIMEOUT_S = 1.5

policy_server: Any = sys.modules[__name__]


def encoded(action: Any) -> bytes:
    """A result as its frame."""
    data = pickle.dumps(action)
    return _LENGTH.pack(len(data)) + data


def play(folder: str) -> None:
    """The whole episode; whatever the policy raises ends it."""
    os.chdir(folder)
    sys.path.insert(0, folder)
    import policy  # type: ignore[import-not-found]

    mind = policy.Policy({}, {}, {})
    mind.reset(0)
    position = 0.0
    for _ in range(N_STEPS):
        if not os.read(COMMANDS, 1):
            return
        action = mind.act(np.array([position, 0.0, 0.0]))
        # What a simulator does with it; one that is given NaN or an infinity does not recover.
        position += float(np.asarray(action, dtype=np.float64).reshape(-1)[0])
        if not np.isfinite(position):
            raise FloatingPointError("the state is not finite any more")
        os.write(REPLIES, policy_server.encoded(action))


def harmed(source: str, timeout_s: float = _TIMEOUT_S) -> str | None:
    """The outcome of an episode of that policy; None when it is the honest one, step by step."""
    with tempfile.TemporaryDirectory(prefix="evp-undefended-") as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        (folder / "policy.py").write_text(source)
        output = stack.enter_context(open(folder / "output", "w+b"))
        results = folder / "results"
        commands, going = os.pipe()
        try:
            os.write(going, bytes(N_STEPS))
            process = _started(folder, commands, results, output)
        finally:
            os.close(commands)
            os.close(going)
        try:
            status = process.wait(_timeout_left(results, timeout_s, process))
        except subprocess.TimeoutExpired:
            return "it never came to its end"
        finally:
            process.kill()
            process.wait()
        if status:
            return f"the environment's process ended with status {status}"
        if os.path.getsize(folder / "output") > MAX_OUTPUT:
            return "its output was kept without limit"
        believed = subprocess.run(
            [sys.executable, __file__, "--believe", str(results)], capture_output=True, text=True, check=False
        )
        return believed.stdout.strip() or None


def _started(folder: Path, commands: int, results: Path, output: Any) -> subprocess.Popen[bytes]:
    replies = os.open(results, os.O_WRONLY | os.O_CREAT, 0o600)
    try:
        return subprocess.Popen(
            [sys.executable, __file__, str(folder), str(commands), str(replies)],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            pass_fds=[commands, replies],
        )
    finally:
        os.close(replies)


def _arrange(commands: int, replies: int) -> None:
    """As a slot has it, and nothing that would fill the disk."""
    high = os.dup2(commands, 100), os.dup2(replies, 101)
    os.dup2(high[0], COMMANDS)
    os.dup2(high[1], REPLIES)
    os.closerange(5, 200)
    resource.setrlimit(resource.RLIMIT_FSIZE, (MAX_FILE, MAX_FILE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _timeout_left(results: Path, timeout_s: float, process: subprocess.Popen[bytes]) -> float:
    """Counted from the first result: how long the start takes is the machine's affair."""
    end = time.monotonic() + 60.0
    while process.poll() is None and results.stat().st_size == 0 and time.monotonic() < end:
        time.sleep(0.01)
    return timeout_s


def believe(path: str) -> str:
    """The harm to a reader who trusts the results; empty when they are sixty honest actions."""
    data = Path(path).read_bytes()
    at, n = 0, 0
    while at < len(data):
        if len(data) < at + 4 or len(data) < at + 4 + _LENGTH.unpack_from(data, at)[0]:
            return "a result is announced that never comes"
        (length,) = _LENGTH.unpack_from(data, at)
        action = pickle.loads(data[at + 4 : at + 4 + length])
        if action != [0.0]:
            return f"a result is {str(action)[:60]}"
        at += 4 + length
        n += 1
    return "" if n == N_STEPS else f"there are {n} results"


if __name__ == "__main__":
    if sys.argv[1] == "--believe":
        try:
            print(believe(sys.argv[2]))
        except Exception as error:
            print(f"the results cannot be read: {type(error).__name__}")
    else:
        _arrange(int(sys.argv[2]), int(sys.argv[3]))
        play(sys.argv[1])
