"""A policy that harms itself has failed, or nothing changes; neither gives it another throw of its dice."""

from __future__ import annotations

import msgspec
import pytest
from slots import HONEST, QUICK, Slots, acting, pid_of, rows
from stateful_policy import kill_policy, struck

SELF_MADE = {
    "abort": "os.abort()",
    "a segmentation fault": "ctypes.string_at(0)",
    "a full stack": "f = ctypes.CFUNCTYPE(ctypes.c_int)(lambda: f()); sys.setrecursionlimit(1 << 30); f()",
    "_exit": "os._exit(9)",
    "all signals by kill": "every(lambda k: os.kill(os.getpid(), k))",
    "all signals by raise": "every(signal.raise_signal)",
    "all signals by pthread_kill": "every(lambda k: signal.pthread_kill(threading.get_ident(), k))",
    "all signals by number": "every(lambda k: libc.syscall(62, os.getpid(), k))",
    "all signals by tgkill": "every(lambda k: libc.syscall(234, os.getpid(), threading.get_native_id(), k))",
    "all signals by tkill": "every(lambda k: libc.syscall(200, threading.get_native_id(), k))",
    "all signals, queued": "every(lambda k: libc.syscall(129, os.getpid(), k, bytes(128)))",
    "all signals to a group": "every(lambda k: os.killpg(0, k))",
    "all signals to everyone": "every(lambda k: os.kill(-1, k))",
    "SIGKILL from a timer": (
        "timer(9); t = time.monotonic()\n            while time.monotonic() < t + 0.3: pass"
    ),
    "SIGSTOP from a timer": (
        "timer(19); t = time.monotonic()\n            while time.monotonic() < t + 0.3: pass"
    ),
    "a processor limit of its own": (
        "resource.setrlimit(resource.RLIMIT_CPU, (1, 1))\n            while True: pass"
    ),
    "a processor limit by number": (
        "libc.syscall(160, 0, struct.pack('<QQ', 1, 1)) and 1 / 0\n            while True: pass"
    ),
    "a processor limit from an address of which half is nought": (
        "at = libc.mmap(1 << 40, 4096, 3, 0x32, -1, 0); ctypes.memmove(at, struct.pack('<QQ', 1, 1), 16)\n"
        "            libc.prlimit(0, 0, ctypes.c_void_p(at), None) and 1 / 0\n            while True: pass"
    ),
    "a parent's death signal": "libc.prctl(1, 9) and 1 / 0",
    "a strict filter": "libc.prctl(22, 1) and 1 / 0\n            os.getppid()",
    "becoming nothing": "os.execv('/bin/false', ['false'])",
    "a call of the other architecture": "run(b'\\x6a\\x14\\x58\\xcd\\x80\\xc3')",
    "an illegal instruction": "run(b'\\x0f\\x0b')",
    "a halt": "run(b'\\xf4')",
    "more memory than there may be": "self.a = bytearray(1 << 40)",
    "all memory that there may be": "self.a = [bytearray(1 << 20) for _ in iter(int, 1)]",
    "threads without end": "[threading.Thread(target=time.sleep, args=(9,)).start() for _ in iter(int, 1)]",
    "files without end": "[open(f'f{k}', 'wb').write(bytes(1 << 20)) for k in range(1 << 30)]",
    "a mapped file without room": (
        "import mmap; f = open('/tmp/m', 'wb+'); f.truncate(3 << 20); g = open('/tmp/n', 'wb')\n"
        "            m = mmap.mmap(f.fileno(), 3 << 20)\n            try: g.write(bytes(4 << 20)); g.flush()\n"
        "            except OSError: pass\n            m[:] = bytes([1]) * (3 << 20)"
    ),
    "no pipes": "os.closerange(0, 256)",
    "no main thread": (
        "threading.Thread(target=lambda: (time.sleep(0.1), os.closerange(0, 256), time.sleep(9))).start()\n"
        "            libc.syscall(60, 0)"
    ),
    "a broken return from a signal": "libc.syscall(15)",
    "no address for its thread": "libc.syscall(334, 1, 32, 0, 0); run(b'\\x48\\x31\\xe4\\x50\\xc3')",
}

CLOCKED = acting(
    """
        self.n += 1
        if self.n == 1:
            # Its luck.
            return [(time.time_ns() % 1000) / 1000]
        if self.n == AT:
            WAY
        return [0.0]
    """,
    init="self.n = 0",
    before="""
        import ctypes, os, resource, signal, struct, sys, threading, time

        libc = ctypes.CDLL(None, use_errno=True)
        libc.mmap.restype = ctypes.c_void_p
        libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t] + [ctypes.c_int] * 3 + [ctypes.c_long]

        def every(send):
            for number in [9, 19, 20, 21, 22, *range(1, 65)]:
                try:
                    send(number)
                except (OSError, ValueError):
                    pass
            time.sleep(0.05)

        def timer(number):
            which = ctypes.c_int()
            event = struct.pack("<qii48x", 0, number, 0)
            if libc.syscall(222, 1, event, ctypes.byref(which)):
                raise OSError(ctypes.get_errno(), "timer_create")
            libc.syscall(223, which.value, 0, struct.pack("<qqqq", 0, 0, 0, 10_000_000), None)

        def run(code):
            at = libc.mmap(None, 4096, 7, 0x22, -1, 0)
            ctypes.memmove(at, code, len(code))
            ctypes.CFUNCTYPE(None)(at)()
    """,
)


@pytest.mark.parametrize("tier", ["bwrap", "landlock"])
@pytest.mark.parametrize("at", [4, 60])
def test_a_policy_whose_luck_is_the_clock_never_throws_again(slots: Slots, tier: str, at: int) -> None:
    """Attack: ends itself, its sandbox, or its environment after bad luck, to be played again. Defence:
    every end that it can cause is its result; after a restart, the actions that it returned remain
    valid (table in `docs/explanation/hostile-policies.md`)."""
    limits = msgspec.structs.replace(QUICK, act_wall_s=1.0, cpu_s=1.5)
    slot = slots.slot(tier)  # type: ignore[arg-type]
    slots.play(HONEST, tier=tier)
    pid = pid_of(slot)
    for name, way in SELF_MADE.items():
        slot._stderr.clear()
        outcome = slots.play(CLOCKED.replace("WAY", way).replace("AT", str(at)), tier=tier, limits=limits)
        assert outcome.length == 60, name
        assert not any("started again" in line for line in slot._stderr), (name, outcome.failure)
        if outcome.failure is not None:
            assert outcome.failure.step_index == at - 1, name
    assert pid_of(slot) == pid
    assert slots.play(HONEST, tier=tier).failure is None


def test_what_a_policy_had_returned_stands_when_it_is_started_again(slots: Slots) -> None:
    """Attack: ends itself, its sandbox, or its environment after bad luck, to be played again. Defence:
    every end that it can cause is its result; after a restart, the actions that it returned remain
    valid (table in `docs/explanation/hostile-policies.md`)."""
    luck = "luck = (time.time_ns() // 1000 % 1_000_000) / 1e6; print(luck, flush=True); return [luck]"
    source = CLOCKED.replace("return [(time.time_ns() % 1000) / 1000]", luck)
    source = source.replace("WAY", "time.sleep(3)").replace("AT", "31")
    (outcome,) = slots.run(struck(slots.slot(), slots, kill_policy, source))
    assert outcome.failure is None
    # What it says it threw is the second throw; what it played is the first.
    assert rows(outcome)[0].action != [float(outcome.stdout)]
    assert isinstance(rows(outcome)[0].action[0], float)
