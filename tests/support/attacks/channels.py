"""Ways for a policy to send bits to other processes of its machine, and the share that arrives.

A writer (a policy in a sealed slot) sends bits by the clock, one a period. A reader (a program in an agent's jail, or
another policy) samples what it can see. What it makes of it, with a threshold learnt from the first half of the bits,
says how many of the others arrive.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import math
import random
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import msgspec
from slots import QUICK, Slots, make_job

from evopolicy_gateway.jail.installs import needs_of
from evopolicy_gateway.jail.jail import Way
from evopolicy_gateway.jail.view import JailView
from evopolicy_worker.slots.slot import Slot

PERIOD_S = 0.05
LIMITS = msgspec.structs.replace(QUICK, episode_wall_s=300.0, act_wall_s=250.0, init_wall_s=60.0, cpu_s=280.0)

WAYS = {
    "writes files": ("shmem", "shared_ram", "free_ram"),
    "computes": ("own_speed", "load", "cpu_time"),
    "has threads": ("processes", "threads_started"),
    "opens a library": ("opens",),
}
"""The actions of a writer, each with the readings by which a reader may notice it."""

WRITER = """
import ctypes, json, os, sys, threading, time
GIVEN = json.load(open("given.json"))
LIBRARY = os.path.realpath(sys.executable)

def send(way, bit, end):
    if way == "writes files":
        with open("/tmp/f", "wb") as file:
            file.truncate(0) if not bit else file.write(bytes(3 << 20))
    elif way == "computes" and bit:
        while time.monotonic() < end: pass
    elif way == "has threads" and bit:
        [threading.Thread(target=lambda: time.sleep(max(0.0, end - time.monotonic()))).start() for _ in range(4)]
    elif way == "opens a library" and bit:
        [os.close(os.open(LIBRARY, os.O_RDONLY)) for _ in range(20)]

    elif way == "all that lasts" and bit:
        names = [f"/tmp/{os.urandom(8).hex()}" for _ in range(2000)]
        [os.path.exists(f"{folder}/{name}") for folder in ("/usr/lib", os.path.dirname(os.__file__)) for name in names]
        [os.close(os.open(name, os.O_CREAT)) for name in names]
        [os.unlink(name) for name in names]
        [threading.Thread(target=lambda: None).start() for _ in range(4)]
        while time.monotonic() < end: pass

class Policy:
    def __init__(self, *spaces): self.n = 0
    def reset(self, episode_index): pass
    def act(self, obs):
        self.n += 1
        if self.n == 1:
            for k, bit in enumerate(GIVEN["bits"]):
                start = GIVEN["start"] + k * GIVEN["period"]
                time.sleep(max(0.0, start - time.monotonic()))
                send(GIVEN["way"], bit, start + 0.7 * GIVEN["period"])
        return [0.0]
"""

READINGS = """
import ctypes, os, struct, sys, time
libc = ctypes.CDLL(None, use_errno=True)
NOTES = []

def watch_library():
    # Opens and closes: one event of a kind after the other, such as two opens, is one event.
    watch = libc.inotify_init1(0o4000)
    if watch >= 0 and libc.inotify_add_watch(watch, os.path.realpath(sys.executable).encode(), 0x38) >= 0:
        NOTES.append(watch)

def opens():
    try:
        return len(os.read(NOTES[0], 1 << 16)) / 16
    except BlockingIOError:
        return 0.0

def lines(path):
    with open(path) as file:
        return {line.split()[0].rstrip(":"): line.split()[1:] for line in file if line.strip()}

def sysinfo():
    room = ctypes.create_string_buffer(128)
    if libc.sysinfo(room) < 0:
        raise OSError(ctypes.get_errno(), "sysinfo")
    up, l1, l5, l15, ram, free, shared, buffers, swap, free_swap, procs = struct.unpack_from("<10QH", room)
    return {"load": l1, "free_ram": free, "shared_ram": shared, "processes": procs}

def own_speed(end):
    n = 0
    while time.monotonic() < end:
        n += 1
    return n

def pipe_number():
    read, write = os.pipe()
    try:
        return os.fstat(read).st_ino
    finally:
        os.close(read), os.close(write)

def statvfs(path):
    return os.statvfs(path).f_bfree

READERS = {
    "shmem": lambda: float(lines("/proc/meminfo")["Shmem"][0]),
    "slab": lambda: float(lines("/proc/meminfo")["Slab"][0]),
    "cached": lambda: float(lines("/proc/meminfo")["Cached"][0]),
    "cpu_time": lambda: sum(map(float, lines("/proc/stat")["cpu"])),
    "threads_started": lambda: float(lines("/proc/stat")["processes"][0]),
    "pipe_number": pipe_number,
    "free_blocks": lambda: statvfs("."),
    "opens": opens,
    **{name: (lambda name=name: sysinfo()[name]) for name in ("load", "free_ram", "shared_ram", "processes")},
}

def readings(names):
    found = {}
    for name in names:
        try:
            found[name] = READERS[name]()
        except Exception as error:
            found[name] = None
    return found
"""

READER = (
    READINGS
    + """
import json
given = json.loads(sys.argv[1])
watch_library()
found = {name: [] for name in given["names"]}
print("ready", flush=True)
given["start"] = float(sys.stdin.readline())
for k in range(given["n"]):
    start = given["start"] + k * given["period"]
    time.sleep(max(0.0, start + 0.1 * given["period"] - time.monotonic()))
    speed = own_speed(start + 0.6 * given["period"]) if "own_speed" in given["names"] else 0
    time.sleep(max(0.0, start + 0.6 * given["period"] - time.monotonic()))
    for name, value in {**readings(set(given["names"]) - {"own_speed"}), "own_speed": speed}.items():
        if name in found:
            found[name].append(value)
print(json.dumps(found))
"""
)

LISTENER = (
    READINGS
    + """
import json
GIVEN = json.load(open("given.json"))

class Policy:
    def __init__(self, *spaces): self.n = 0
    def reset(self, episode_index): pass
    def act(self, obs):
        self.n += 1
        if self.n == 1:
            found = []
            for k in range(len(GIVEN["bits"])):
                start = GIVEN["start"] + k * GIVEN["period"]
                time.sleep(max(0.0, start + 0.1 * GIVEN["period"] - time.monotonic()))
                found.append(own_speed(start + 0.6 * GIVEN["period"]))
            print(json.dumps(found))
        return [0.0]
"""
)

LOOKER = READINGS + "\nimport json\nprint(json.dumps(readings(READERS)))\n"
"""Looks once."""


class JailedReader:
    """Starts programs in an agent's jail, as its agent supervisor does."""

    def __init__(self, folder: Path) -> None:
        workspace = folder / "workspace"
        (workspace / "feedback").mkdir(parents=True)
        self._folder = folder
        self._view = JailView(
            workspace=workspace,
            private=folder / "private",
            home="/home/agent",
            needs=needs_of([sys.executable], None),
            read=(),
            write=(),
            hidden=(),
            open_network=False,
        )
        self._view.prepare()

    def start(self, source: str, *arguments: str) -> subprocess.Popen[str]:
        """A running program; its input and output are pipes."""
        python = str(Path(getattr(sys, "_base_executable", sys.executable)).resolve())
        way = Way(self._view.arguments(), [python, "-c", source, *arguments], None)
        try:
            return subprocess.Popen(
                way.words, pass_fds=way.pass_fds, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        finally:
            way.failed()

    def look(self) -> dict[str, float | None]:
        """All readings, once."""
        output, _ = self.start(LOOKER).communicate(timeout=60)
        found: dict[str, float | None] = json.loads(output)
        return found


def live(
    slots: Slots, reader: JailedReader, way: str, n: int = 80, period_s: float = PERIOD_S
) -> dict[str, float]:
    """Bits a second that an agent in its jail gets of a policy at the same time, by reading."""
    bits = [random.getrandbits(1) for _ in range(n)]
    names = WAYS[way]
    listening = reader.start(READER, json.dumps({"names": names, "n": n, "period": period_s}))
    assert listening.stdin is not None
    assert listening.stdout is not None
    assert listening.stdout.readline() == "ready\n"
    start = time.monotonic() + 1.5
    parameters = {"way": way, "bits": bits, "start": start, "period": period_s}
    listening.stdin.write(f"{start}\n")
    listening.stdin.flush()
    play(slots, parameters)
    output, _ = listening.communicate(timeout=120)
    values = json.loads(output)
    return {name: arrived(bits, values[name]) / period_s for name in names}


def between_policies(slots: Slots, cores: tuple[int, int], n: int = 80) -> float:
    """Bits a second that one policy gets of another at the same time, by how fast it computes itself."""
    bits = [random.getrandbits(1) for _ in range(n)]
    pair = [Slot(core, "bwrap", slots.folder / f"core-{k}-{core}") for k, core in enumerate(cores)]
    try:
        for slot in pair:
            slots.run(slot.start())
        parameters = {"way": "computes", "bits": bits, "start": time.monotonic() + 3.0, "period": PERIOD_S}
        plays = []
        for slot, source in zip(pair, (WRITER, LISTENER), strict=True):
            folder = slots.bundle({"policy.py": source, "given.json": json.dumps(parameters)})
            plays.append(slot.play_job(make_job(limits=LIMITS), folder, lambda episodes, steps: None))

        async def both() -> Any:
            return await asyncio.gather(*plays)

        (_,), (heard,) = slots.run(both(), timeout_s=120.0)
        return arrived(bits, json.loads(heard.stdout)) / PERIOD_S
    finally:
        for slot in pair:
            slots.run(slot.close())


def afterwards(slots: Slots, reader: JailedReader, wait_s: float, n: int) -> dict[str, float]:
    """Of `n` episodes, half of which did all that lasts: which share each reading tells apart, `wait_s` after they
    ended."""
    kinds = [k % 2 for k in range(n)]
    random.shuffle(kinds)
    moved: dict[str, list[float | None]] = {}
    for kind in kinds:
        before = reader.look()
        parameters = {"way": "all that lasts", "bits": [kind] * 4, "period": 0.7}
        play(slots, parameters | {"start": time.monotonic() + 0.5})
        time.sleep(wait_s)
        for name, value in reader.look().items():
            old = before[name]
            moved.setdefault(name, []).append(None if value is None or old is None else value - old)
    return {name: _separated(kinds, values) for name, values in moved.items() if None not in values}


def _separated(kinds: list[int], values: list[Any]) -> float:
    """Share of the episodes that lie nearer to the mean of the others of their kind."""
    right = 0
    for k, (kind, value) in enumerate(zip(kinds, values, strict=True)):
        means = [
            statistics.fmean(other for j, other in enumerate(values) if j != k and kinds[j] == which)
            for which in (0, 1)
        ]
        right += abs(value - means[kind]) < abs(value - means[1 - kind])
    return right / len(kinds)


def play(slots: Slots, parameters: dict[str, Any]) -> None:
    """One episode of the writer."""
    folder = slots.bundle({"policy.py": WRITER, "given.json": json.dumps(parameters)})
    playing = slots.slot().play_job(make_job(limits=LIMITS), folder, lambda episodes, steps: None)
    (outcome,) = slots.run(playing, timeout_s=300.0)
    assert outcome.failure is None, outcome.failure


def arrived(bits: list[int], values: list[float | None]) -> float:
    """Bits a symbol, of 1, that these values tell: the better of the values and their changes."""
    if any(value is None for value in values) or len(set(values)) < 2:
        return 0.0
    plain = [float(value) for value in values if value is not None]
    changes = [0.0, *(after - before for before, after in itertools.pairwise(plain))]
    return max(_share_read(bits, plain), _share_read(bits, changes))


def _share_read(bits: list[int], values: list[float]) -> float:
    half = len(bits) // 2
    wrong, cut, upwards = half, 0.0, True
    for threshold in sorted(set(values[:half])):
        for up in (True, False):
            errors = sum(
                ((value >= threshold) == up) != bool(bit)
                for bit, value in zip(bits[:half], values[:half], strict=True)
            )
            if errors < wrong:
                wrong, cut, upwards = errors, threshold, up
    later = list(zip(bits[half:], values[half:], strict=True))
    missed = sum(((value >= cut) == upwards) != bool(bit) for bit, value in later)
    # Fewer errors than chance gives one time in a hundred; else nothing arrived.
    n = len(later)
    if missed > n / 2 - 1.2 * math.sqrt(n):
        return 0.0
    share = max(missed, 0.5) / n
    return 1 + share * math.log2(share) + (1 - share) * math.log2(1 - share)
