"""The corpus's breakers: policies that misbehave at step 3 of an episode or before its first, and their verdicts.

Three ways in which one is seen to succeed undefended: under a higher limit, in a process that is not sealed, or in the
environment's own process (`undefended.py`).

Attacks, each with its defence:
- returns an array of zero bytes that becomes four billion lists, or large actions in every step, to overload
  the gateway: both sides bound the axes, numbers, and empty lists of an action, and an episode's total beyond
  the action space.
"""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any

import msgspec
from slots import QUICK, misbehaving

from evopolicy_common.messages.episode import ResourceLimits

PATIENT = msgspec.structs.replace(QUICK, act_wall_s=50.0, init_wall_s=50.0, episode_wall_s=100.0, cpu_s=100.0)
"""Where the verdict is none of time, a busy machine shall not make it one."""


class Breaker(msgspec.Struct, frozen=True, kw_only=True):
    """Code that misbehaves, and its verdict."""

    name: str
    act: str = "pass"
    reset: str = "pass"
    init: str = "pass"
    verdict: str | None
    """The failure's category; None when the episode goes on unharmed."""
    limits: ResourceLimits = PATIENT
    off: ResourceLimits | None = None
    """Limits under which the same code succeeds; None when the defence is not a limit."""
    unsealed: bool = False
    """Whether it succeeds when the policy's process is not sealed (its numbers are bounded, so the machine is safe)."""
    packages: tuple[str, ...] = ()
    """Packages besides numpy that it imports."""
    possible: bool = True
    """Whether this machine's kernel has the calls that it makes, so that it can be seen to succeed."""
    harmless_anywhere: bool = False
    """Whether there is nothing to defend against, as the corpus is to show."""

    @property
    def in_process(self) -> bool:
        """Whether it is seen to succeed in the environment's own process."""
        return self.off is None and not self.unsealed and not self.harmless_anywhere

    @property
    def source(self) -> str:
        return misbehaving(init=self.init, reset=self.reset, act=self.act)


def limits(**changes: Any) -> ResourceLimits:
    return msgspec.structs.replace(PATIENT, **changes)


PLAIN: dict[str | None, dict[str, str]] = {
    "killed": {
        "closes its reply pipe": "os.close(4); time.sleep(60)",
        "closes its request pipe": "os.close(3)",
        "closes every descriptor": "os.closerange(0, 256)",
        "a random reply": "os.write(4, os.urandom(300))",
        "an endless reply": "os.write(4, struct.pack('<IBxxx', 1 << 31, 3)); time.sleep(60)",
        "two replies to one request": "os.write(4, struct.pack('<IBxxxqIBxxxq', 8, 1, 0, 8, 1, 0))",
        "a reply of the wrong kind": "os.write(4, struct.pack('<IBxxx', 0, 0)); time.sleep(60)",
        "an array of objects as a reply": (
            "os.write(4, struct.pack('<IBxxx4sIIQ', 20, 3, b'|O\\0\\0', 1, 1, id(self))); time.sleep(60)"
        ),
        "a forged failure": "os.write(4, struct.pack('<IBxxx', 2, 6) + b'{}'); time.sleep(60)",
        "a forged count that no encoder accepts": (
            'b = b\'{"stage":"act","kind":"action","message":"","traceback":"","used":1\' + b"0" * 30 + b"}"\n'
            "            os.write(4, struct.pack('<IBxxx', len(b), 6) + b); time.sleep(60)"
        ),
        "a forged sandbox failure": "os.write(4, struct.pack('<IBxxx', 4, 7) + b'ours'); time.sleep(60)",
        "a flood of replies": "[os.write(4, bytes(65536)) for _ in iter(int, 1)]",
        "a forged huge action": (
            "os.write(4, struct.pack('<IBxxx', 1 << 16, 5) + bytes(1 << 16)); time.sleep(60)"
        ),
        "a forged action of thousands of empty lists": (
            "os.write(4, struct.pack('<IBxxx', 8003, 5) + b'\\xdc\\x1f\\x40' + b'\\x90' * 8000); "
            "time.sleep(60)"
        ),
        "a forged array of four billion empty lists": (
            "os.write(4, struct.pack('<IBxxx4sIII', 16, 3, b'|u1', 2, 2**32 - 1, 0)); time.sleep(60)"
        ),
        "os._exit": "os._exit(0)",
        "a segmentation fault": "ctypes.string_at(1)",
        "an abort": "os.abort()",
        "all built-in functions deleted": "import builtins\n            vars(builtins).clear()",
        "exchanged pipes": "k = os.dup(3); os.dup2(4, 3); os.dup2(k, 4); return 0.0",
        "a file of its own in place of the reply pipe": (
            "os.dup2(os.open('f', os.O_RDWR | os.O_CREAT), 4); time.sleep(60)"
        ),
        "signals in the middle of a reply": (
            "signal.signal(signal.SIGALRM, lambda *a: os.write(4, b'zz'))\n"
            "            signal.setitimer(signal.ITIMER_REAL, 0.001, 0.001); time.sleep(0.1)"
        ),
        "a thread that continues to reply": (
            "threading.Thread(target=lambda: [os.write(4, 2 * struct.pack('<IBxxxq', 8, 1, 0)) or time.sleep(0.001) for"
            " _ in range(9999)]).start(); time.sleep(0.1)"
        ),
    },
    "act_error": {
        "an array of four billion empty lists": "return np.empty((2**31, 2**31, 0))",
        "an endless dict": (
            "D = type('D', (dict,), {'items': lambda s: iter(lambda: ('a', 1), None)}); return D()"
        ),
        "a list that reports a wrong length": (
            "L = type('L', (list,), {'__len__': lambda s: 1 << 40}); return L([1.0])"
        ),
        "a nested action": "a = []; [a := [a] for _ in range(100000)]; return a",
        "an action that contains itself": "a = []; a.append(a); return a",
        "an action whose `__array__` raises": (
            "return type('L', (), {'__array__': lambda s, *a, **k: 1 / 0})()"
        ),
        "stopping itself": "os.kill(os.getpid(), signal.SIGSTOP); time.sleep(60)",
        "killing itself, to be played again": "os.kill(os.getpid(), signal.SIGKILL); time.sleep(60)",
        "a timer that kills itself": (
            "libc, which = ctypes.CDLL(None), ctypes.c_void_p()\n"
            "            event = struct.pack('<qii48x', 0, 9, 0)\n"
            "            if libc.timer_create(1, event, ctypes.byref(which)): raise OSError('no timer')\n"
            "            libc.timer_settime(which, 0, struct.pack('<qqqq', 0, 0, 0, 10**7), None); time.sleep(60)"
        ),
        "a lower limit on its CPU time, to be killed by the kernel": (
            "import resource; resource.setrlimit(resource.RLIMIT_CPU, (1, 1))\n            while True: pass"
        ),
        "endless recursion": "f = lambda: f(); f()",
        "an error that cannot be printed": "raise type('E', (Exception,), {'__str__': lambda s: 1 / 0})",
        "an error that raises when it is read": (
            "raise type('E', (OSError,), {'errno': property(lambda s: 1 / 0)})"
        ),
        "an error with half a surrogate pair in its text": "raise ValueError(chr(0xD800))",
        "tracing every call": "sys.setprofile(lambda *a: 1 / 0)",
    },
    None: {
        "an array of objects as an action": "return np.array([self, None], dtype=object)",
        "a generator as an action": "return (x for x in [1.0])",
        "infinity as an action": "return [float('inf')]",
        "NaN as an action": "return [float('nan')]",
        "a pickle": (
            "return type('P', (), {'__reduce__': lambda s: (os.system, ('touch /tmp/evopolicy-pickled',))})()"
        ),
        "a signal for an illegal instruction": "signal.raise_signal(signal.SIGILL)",
        "a flood of output": "[os.write(k, b'x' * 65536) for k in (1, 2) for _ in range(200)]",
        "a replaced shim": (
            "import gc\n            for m in list(sys.modules.values()):\n                for n in ('encoded', 'reply',"
            " 'answer', 'check', 'seal'):\n                    if hasattr(m, n) and hasattr(m, 'REPLIES'): setattr(m,"
            " n, None)\n            m = sys.modules['__main__']; m.policy_server.encoded = lambda action:"
            " struct.pack('<IBxxxd', 8, 2, 9.0)"
        ),
        "all modules deleted": "sys.modules.clear(); sys.stdout = sys.stderr = None; return []",
    },
}
"""Code for `act`, by verdict and name, under the usual limits and with no other way to succeed."""

BREAKERS = (
    Breaker(
        name="endless act",
        act="time.sleep(0.8)",
        verdict="act_timeout",
        limits=limits(act_wall_s=0.3),
        off=PATIENT,
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
        off=PATIENT,
    ),
    Breaker(
        name="slow episode",
        act="time.sleep(0.8)",
        verdict="episode_timeout",
        limits=limits(episode_wall_s=0.4),
        off=PATIENT,
    ),
    Breaker(
        name="sleeping __init__",
        init="time.sleep(0.8)",
        verdict="init_error",
        limits=limits(init_wall_s=0.5),
        off=PATIENT,
    ),
    Breaker(
        name="blocked signals",
        act="signal.pthread_sigmask(signal.SIG_BLOCK, range(1, 65)); time.sleep(0.8)",
        verdict="act_timeout",
        limits=limits(act_wall_s=0.3),
        off=PATIENT,
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
        act=(
            "libc = ctypes.CDLL(None); libc.malloc.restype = ctypes.c_void_p\n"
            "            p = [libc.malloc(ctypes.c_size_t(64 << 20)) for _ in range(6)]\n"
            "            if not all(p): raise MemoryError"
        ),
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
        off=limits(files=20_000),
    ),
    Breaker(
        name="folders without permissions, nested deeper than Python recurses",
        act="[(os.mkdir('d'), os.chdir('d')) for _ in range(1500)]; os.chmod('..', 0)",
        verdict=None,
        harmless_anywhere=True,
    ),
    Breaker(
        name="descriptor exhaustion",
        act="self.f = [os.open('/dev/null', 0) for _ in range(400)]",
        verdict="file_limit",
        unsealed=True,
        off=limits(open_files=600),
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
    Breaker(
        name="half a reply",
        act="os.write(4, b'abc'); time.sleep(60)",
        verdict="act_timeout",
        limits=limits(act_wall_s=0.3),
    ),
    Breaker(
        name="a huge action",
        act="return np.zeros(1 << 16)",
        verdict="act_error",
        off=limits(action_bytes=1 << 20),
    ),
    Breaker(
        name="a large action in every step",
        act="type(self).act = lambda self, obs: np.full(1000, 1e-5, np.float16)",
        verdict="act_error",
        limits=limits(episode_action_bytes=30_000),
        off=PATIENT,
    ),
    Breaker(
        name="a replaced os module under the shim",
        act="os.write = lambda *a: 0; os.readv = None",
        verdict=None,
        limits=limits(act_wall_s=0.3),
    ),
    Breaker(
        name="its output in place of the reply pipe",
        act="os.dup2(1, 4)",
        verdict="killed",
        limits=limits(act_wall_s=0.3),
    ),
    Breaker(
        name="a reply before the request",
        init="os.write(4, struct.pack('<IBxxx', 0, 0)); time.sleep(0.5)",
        verdict="killed",
    ),
    *(
        (
            Breaker(
                name="a system call by its x32 number",
                act="ctypes.CDLL(None).syscall(0x40000027)",
                verdict="killed",
                unsealed=True,
            ),
            Breaker(
                name="a system call of 32-bit programs, from machine code of its own",
                act=(
                    "import mmap; m = mmap.mmap(-1, 4096, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, 7)\n"
                    "            m.write(bytes.fromhex('b814000000cd80c3'))  # mov eax, 20; int 0x80; ret\n"
                    "            pid = ctypes.CFUNCTYPE(ctypes.c_int)(ctypes.addressof(ctypes.c_char.from_buffer(m)))\n"
                    "            if pid() != os.getpid(): raise OSError('no such call')"
                ),
                verdict="killed",
                unsealed=True,
                possible=Path("/proc/sys/abi/vsyscall32").exists(),
            ),
        )
        if platform.machine() == "x86_64"
        else ()
    ),
    Breaker(
        name="a C function at address 0, which scipy calls",
        act=(
            "from scipy import LowLevelCallable, integrate\n"
            "            kind = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double)\n"
            "            integrate.quad(LowLevelCallable(ctypes.cast(1, kind)), 0.0, 1.0)"
        ),
        verdict="killed",
        packages=("scipy",),
    ),
    Breaker(
        name="disk filling by scipy's files",
        act="import scipy.io; scipy.io.savemat('f.mat', {'a': np.zeros(1 << 20)})",
        verdict="file_limit",
        packages=("scipy",),
        off=limits(file_bytes=16 << 20),
    ),
    Breaker(
        name="memory bomb in scipy's C code",
        act="import scipy.ndimage; self.a = scipy.ndimage.zoom(np.ones((300, 300)), 22, order=0)",
        verdict="oom",
        packages=("scipy",),
        unsealed=True,
    ),
    *(
        Breaker(name=name, act=act, verdict=verdict)
        for verdict, acts in PLAIN.items()
        for name, act in acts.items()
    ),
)
