"""The corpus of hostile policies: what each does, the verdict it must get, and how its defence is switched off.

Two kinds. *Probes* (files in `policies/`) try one door after another and print `held: …` or `THROUGH: …`: their verdict
is an ordinary episode in which every door held. *Breakers* misbehave at step 3 of an episode, or before its first; their
verdict is the failure's category. The table in docs/hostile-policies.md is made by

    PYTHONPATH=tests/support python tests/conformance/hostile/corpus.py > docs/hostile-policies.md
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
from slots import QUICK

from evopolicy_common.messages.episode import ResourceLimits

POLICIES = Path(__file__).parent / "policies"

PROBE = """
import attack

class Policy:
    def __init__(self, *spaces):
        self.n = 0

    def reset(self, episode_index):
        pass

    def act(self, obs):
        self.n += 1
        if self.n == 4:
            for what, attempt in attack.attempts():
                try:
                    got = attempt()
                except BaseException as error:
                    print("held:", what, "-", type(error).__name__, error, flush=True)
                else:
                    print("THROUGH:" if got else "held:", what, "-", repr(got)[:80], flush=True)
        return [0.0]
"""

BREAKER = """
import ctypes, json, os, signal, struct, sys, threading, time
import numpy as np

class Policy:
    def __init__(self, *spaces):
        self.n = 0
        {init}

    def reset(self, episode_index):
        {reset}

    def act(self, obs):
        self.n += 1
        if self.n == 4:
            {act}
        return [0.0]
"""


class Probe(msgspec.Struct, frozen=True, kw_only=True):
    """A file that tries doors."""

    name: str
    off: dict[str, Any] | None
    """Options under which every door not in `stays_shut` is seen to open: a weaker tier, or no seal; None where no
    unprivileged process of an ordinary machine gets through."""
    stays_shut: frozenset[str] = frozenset()
    """Doors that something else shuts too when this defence is off, or that this machine may not have."""
    opens_for_root: frozenset[str] = frozenset()
    """Doors that file permissions shut too, unless the worker runs as root."""


class Breaker(msgspec.Struct, frozen=True, kw_only=True):
    """Code that misbehaves, and its verdict."""

    name: str
    act: str = "pass"
    reset: str = "pass"
    init: str = "pass"
    verdict: str | None
    """The failure's category; None when the episode goes on unharmed."""
    limits: ResourceLimits = QUICK
    off: ResourceLimits | None = None
    """Limits under which the same code succeeds; None when the defence is not a limit."""
    unsealed: bool = False
    """Whether it succeeds when the policy's process is not sealed (its numbers are bounded, so the machine is safe)."""

    @property
    def source(self) -> str:
        return BREAKER.format(init=self.init, reset=self.reset, act=self.act)


def limits(**changes: Any) -> ResourceLimits:
    return msgspec.structs.replace(QUICK, **changes)


NO_SEAL = {"tier": "bwrap", "sealed": False}
NO_SANDBOX = {"tier": "none"}

PROBES = (
    Probe(
        name="read_files",
        off=NO_SANDBOX,
        stays_shut=frozenset({"a hard link", "home folders", "the host's name"}),
    ),
    Probe(
        name="write_files",
        off=NO_SANDBOX,
        stays_shut=frozenset({"shared memory"}),
        opens_for_root=frozenset({"numpy's folder", "the standard library", "the devices", "the root"}),
    ),
    Probe(
        name="list_processes",
        off=NO_SANDBOX,
        stays_shut=frozenset(),
    ),
    Probe(name="sockets", off=NO_SANDBOX, stays_shut=frozenset({"interfaces"})),
    Probe(
        name="other_processes",
        off=NO_SANDBOX,
        stays_shut=frozenset(
            {
                "signal 0 to pid 2",
                "signal 0 to everyone",
                "being traced",
                "comparing kernel objects",
                "memory of its own through process_vm_readv",
            }
        ),
    ),
    Probe(
        name="kernel",
        off=NO_SEAL,
        stays_shut=frozenset({"an io_uring", "a key", "a new network namespace"}),
    ),
    Probe(name="kernel_root", off=None),
    Probe(name="forks", off=NO_SANDBOX),
    Probe(name="exec_itself", off=NO_SANDBOX),
    Probe(
        name="devices",
        off=NO_SANDBOX,
        stays_shut=frozenset({"kernel messages", "cgroups"}),
    ),
)

BREAKERS = (
    Breaker(
        name="endless act",
        act="time.sleep(0.8)",
        verdict="act_timeout",
        limits=limits(act_wall_s=0.3),
        off=QUICK,
    ),
    Breaker(
        name="endless computing",
        act="t = time.process_time()\n            while time.process_time() < t + 0.7: pass",
        verdict="cpu_limit",
        limits=limits(cpu_s=0.4, act_wall_s=20.0),
        off=limits(act_wall_s=20.0),
    ),
    Breaker(
        name="endless reset",
        reset="time.sleep(0.8)",
        verdict="act_timeout",
        limits=limits(act_wall_s=0.3),
        off=QUICK,
    ),
    Breaker(
        name="slow episode",
        act="time.sleep(0.8)",
        verdict="episode_timeout",
        limits=limits(episode_wall_s=0.4),
        off=QUICK,
    ),
    Breaker(
        name="sleeping __init__",
        init="time.sleep(0.8)",
        verdict="init_error",
        limits=limits(init_wall_s=0.5),
        off=QUICK,
    ),
    Breaker(
        name="blocked signals",
        act="signal.pthread_sigmask(signal.SIG_BLOCK, range(1, 65)); time.sleep(0.8)",
        verdict="act_timeout",
        limits=limits(act_wall_s=0.3),
        off=QUICK,
    ),
    Breaker(
        name="memory bomb",
        act="self.a = [np.empty(1 << 20) for _ in range(50)]",
        verdict="oom",
        unsealed=True,
        off=limits(memory_bytes=1 << 30),
    ),
    Breaker(
        name="memory bomb in C",
        act="libc = ctypes.CDLL(None); libc.malloc.restype = ctypes.c_void_p\n"
        "            p = [libc.malloc(ctypes.c_size_t(64 << 20)) for _ in range(6)]\n"
        "            if not all(p): raise MemoryError",
        verdict="oom",
        unsealed=True,
    ),
    Breaker(
        name="disk filling",
        act="open('/tmp/f', 'wb').write(bytes(6 << 20))",
        verdict="file_limit",
        off=limits(file_bytes=16 << 20),
    ),
    Breaker(
        name="disk filling by many files",
        act="[open(f'f{k}', 'wb').write(bytes(1 << 20)) for k in range(6)]",
        verdict="file_limit",
        off=limits(file_bytes=16 << 20),
    ),
    Breaker(
        name="thousands of files",
        act="[open(f'f{k}', 'w').close() for k in range(9000)]",
        verdict="file_limit",
    ),
    Breaker(
        name="deep folders",
        act="[(os.mkdir('d'), os.chdir('d')) for _ in range(600)]",
        verdict=None,
    ),
    Breaker(
        name="descriptor exhaustion",
        act="self.f = [os.open('/dev/null', 0) for _ in range(400)]",
        verdict="file_limit",
        unsealed=True,
    ),
    Breaker(
        name="thread bomb",
        act="[threading.Thread(target=time.sleep, args=(2,)).start() for _ in range(12)]",
        verdict="process_limit",
        off=limits(processes=32),
    ),
    Breaker(
        name="fork bomb",
        act="self.f = [os.fork() or os._exit(0) for _ in range(3)]",
        verdict="process_limit",
        unsealed=True,
    ),
    Breaker(name="closes its answers", act="os.close(4); time.sleep(60)", verdict="killed"),
    Breaker(name="closes its questions", act="os.close(3)", verdict="killed"),
    Breaker(name="closes everything", act="os.closerange(0, 256)", verdict="killed"),
    Breaker(name="garbage for an answer", act="os.write(4, os.urandom(300))", verdict="killed"),
    Breaker(
        name="an answer without end",
        act="os.write(4, struct.pack('<IBxxx', 1 << 31, 3)); time.sleep(60)",
        verdict="killed",
    ),
    Breaker(
        name="half an answer",
        act="os.write(4, b'abc'); time.sleep(60)",
        verdict="act_timeout",
        limits=limits(act_wall_s=0.3),
    ),
    Breaker(
        name="two answers to one question",
        act="os.write(4, struct.pack('<IBxxxqIBxxxq', 8, 1, 0, 8, 1, 0))",
        verdict="killed",
    ),
    Breaker(
        name="a wrong kind of answer",
        act="os.write(4, struct.pack('<IBxxx', 0, 0)); time.sleep(60)",
        verdict="killed",
    ),
    Breaker(
        name="an array of objects for an answer",
        act="os.write(4, struct.pack('<IBxxx4sIIQ', 20, 3, b'|O\\0\\0', 1, 1, id(self))); time.sleep(60)",
        verdict="killed",
    ),
    Breaker(
        name="a forged failure",
        act="os.write(4, struct.pack('<IBxxx', 2, 6) + b'{}'); time.sleep(60)",
        verdict="killed",
    ),
    Breaker(
        name="a forged fault of the sandbox",
        act="os.write(4, struct.pack('<IBxxx', 4, 7) + b'ours'); time.sleep(60)",
        verdict="killed",
    ),
    Breaker(
        name="a flood of answers", act="[os.write(4, bytes(65536)) for _ in iter(int, 1)]", verdict="killed"
    ),
    Breaker(name="a huge action", act="return np.zeros(1 << 20)", verdict="act_error"),
    Breaker(
        name="a nested action", act="a = []; [a := [a] for _ in range(100000)]; return a", verdict="act_error"
    ),
    Breaker(name="an action that holds itself", act="a = []; a.append(a); return a", verdict="act_error"),
    Breaker(
        name="a pickle",
        act="return type('P', (), {'__reduce__': lambda s: (os.system, ('touch /tmp/evopolicy-pickled',))})()",
        verdict=None,
    ),
    Breaker(
        name="an action that lies about itself",
        act="return type('L', (), {'__array__': lambda s, *a, **k: 1 / 0})()",
        verdict="act_error",
    ),
    Breaker(name="os._exit", act="os._exit(0)", verdict="killed"),
    Breaker(name="a segmentation fault", act="ctypes.string_at(1)", verdict="killed"),
    Breaker(name="an abort", act="os.abort()", verdict="killed"),
    Breaker(
        name="a signal of an illegal instruction", act="signal.raise_signal(signal.SIGILL)", verdict=None
    ),
    Breaker(
        name="stopping itself",
        act="os.kill(os.getpid(), signal.SIGSTOP); time.sleep(60)",
        verdict="act_timeout",
        limits=limits(act_wall_s=0.3),
    ),
    Breaker(name="endless recursion", act="f = lambda: f(); f()", verdict="act_error"),
    Breaker(
        name="an error that cannot be printed",
        act="raise type('E', (Exception,), {'__str__': lambda s: 1 / 0})",
        verdict="act_error",
    ),
    Breaker(
        name="a flood of output",
        act="[os.write(k, b'x' * 65536) for k in (1, 2) for _ in range(200)]",
        verdict=None,
    ),
    Breaker(
        name="another shim",
        act="import gc\n"
        "            for m in list(sys.modules.values()):\n"
        "                for n in ('encoded', 'reply', 'answer', 'check', 'seal'):\n"
        "                    if hasattr(m, n) and hasattr(m, 'REPLIES'): setattr(m, n, None)\n"
        "            m = sys.modules['__main__']; m.player.encoded = lambda action: struct.pack('<IBxxxd', 8, 2, 9.0)",
        verdict=None,
    ),
    Breaker(
        name="a thread that goes on answering",
        act="threading.Thread(target=lambda: [os.write(4, 2 * struct.pack('<IBxxxq', 8, 1, 0)) or time.sleep(0.001) for _ in range(9999)]).start(); time.sleep(0.1)",
        verdict="killed",
    ),
)


def document() -> str:
    """The corpus as markdown: what docs/hostile-policies.md holds."""
    rows = []
    for probe in PROBES:
        first = (POLICIES / f"{probe.name}.py").read_text().split('"""')[1].rstrip(".")
        undefended = {"tier": "with tier `none`", "sealed": "unsealed"}
        off = "-" if probe.off is None else undefended["sealed" if "sealed" in probe.off else "tier"]
        rows.append((first, "no door opens; the episode goes on", off))
    for breaker in BREAKERS:
        verdict = f"`{breaker.verdict}`" if breaker.verdict else "harmless; the episode goes on"
        ways = ["unsealed"] * breaker.unsealed + ["with a higher limit"] * (breaker.off is not None)
        rows.append((breaker.name, verdict, ", ".join(ways) or "-"))
    rows += [(what, "nothing is found", "with tier `none`") for what in PAIRS]
    lines = [f"| {what} | {verdict} | {off} |" for what, verdict, off in rows]
    return "\n".join([HEAD, *lines, ""])


PAIRS = (
    "Leaves files, shared memory and state for the next episode, which looks for them",
    "Two policies in parallel slots talk by files, shared memory, sockets or locks",
    "Searches all objects, frames and generators for the case's seed",
)
HEAD = """# Hostile policies

What the tests in `tests/conformance/hostile/` do to a slot of tier `bwrap`, and what comes of it. After each of them the
slot plays an honest episode. The last column says how the attack was seen to succeed with its defence off.

| attack | verdict | succeeds |
|---|---|---|"""

if __name__ == "__main__":
    print(document(), end="")
