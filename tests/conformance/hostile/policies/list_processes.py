"""Looks for other processes."""
import ctypes, os
libc = ctypes.CDLL(None, use_errno=True)

def attempts():
    yield "/proc", lambda: [name for name in os.listdir("/proc") if name.isdigit() and int(name) != os.getpid()]
    yield "its parent", lambda: os.getppid() > 0
    yield "a signal to its parent", lambda: os.kill(os.getppid() or 2, 0) is None
    yield "a descriptor of its parent", lambda: os.pidfd_open(os.getppid() or 2)
    yield "any pid that answers", lambda: [p for p in range(2, 5000) if libc.getpgid(p) >= 0]
    yield "anything but a low pid of its own", lambda: os.getpid() > 1
