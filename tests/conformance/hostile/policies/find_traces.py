"""Looks for what `leave_traces.py` left in the episode before."""
import ctypes, fcntl, os, time
import numpy
libc = ctypes.CDLL(None, use_errno=True)
X86 = os.uname().machine == "x86_64"

def take(path):
    def run():
        found = os.path.exists(path)
        if found:
            os.unlink(path)
        return found
    return run

def shm():
    found = libc.syscall(29 if X86 else 194, 0xE0E0E0, 4096, 0)
    if found >= 0:
        libc.syscall(31 if X86 else 195, found, 0, None)
    return found >= 0

def attempts():
    yield "in /tmp", take("/tmp/evopolicy-left")
    yield "in shared memory", take("/dev/shm/evopolicy-left")
    yield "in System V memory", shm
    yield "beside its files", take("../evopolicy-left")
    yield "in the flags of its input", lambda: fcntl.fcntl(0, fcntl.F_GETFL) & (os.O_NONBLOCK | os.O_APPEND)
    yield "in a device's times", lambda: abs(time.time() - os.stat("/dev/full").st_mtime) < 2
    yield "in the process", lambda: "LEFT" in os.environ or hasattr(numpy, "LEFT")
