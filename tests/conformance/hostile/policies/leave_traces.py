"""Leaves something for the next episode wherever it can."""
import ctypes, fcntl, os
libc = ctypes.CDLL(None, use_errno=True)
X86 = os.uname().machine == "x86_64"

def leave(path):
    def run():
        with open(path, "w") as file:
            file.write("left")
    return run

def attempts():
    yield "in /tmp", leave("/tmp/evopolicy-left")
    yield "in shared memory", leave("/dev/shm/evopolicy-left")
    yield "beside its files", leave("../evopolicy-left")
    yield "in its files", leave("evopolicy-left")
    yield "in a key", lambda: libc.syscall(248 if X86 else 217, b"user", b"evopolicy-left", b"x", 1, -3) and None
    yield "in System V memory", lambda: libc.syscall(29 if X86 else 194, 0xE0E0E0, 4096, 0o1600) and None
    yield "in the flags of its input", lambda: fcntl.fcntl(0, fcntl.F_SETFL, os.O_NONBLOCK | os.O_APPEND) and None
    yield "in a device's times", lambda: os.utime("/dev/full")
    os.environ["LEFT"] = "left"
    import numpy
    numpy.LEFT = "left"
