"""Asks the kernel for what only sandbox builders and attackers need."""
import ctypes, os
libc = ctypes.CDLL(None, use_errno=True)
X86 = os.uname().machine == "x86_64"

def call(x86, arm, *arguments):
    def run():
        if libc.syscall(x86 if X86 else arm, *arguments) < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        return True
    return run

def personality():
    result = libc.syscall(135 if X86 else 92, 0x0040000)
    if result < 0:
        raise OSError(ctypes.get_errno(), "personality")
    libc.syscall(135 if X86 else 92, result)
    return True

def attempts():
    yield "a mount", call(165, 40, b"none", b"/tmp", b"tmpfs", 0, None)
    yield "a new network namespace", call(272, 97, 0x40000000)
    yield "a new user namespace", call(272, 97, 0x10000000)
    yield "an io_uring", call(425, 425, 4, bytes(120))
    yield "a key", call(250, 219, 1, b"evopolicy-test")
    yield "a pidfd", call(434, 434, os.getpid(), 0)
    yield "memory without a file", call(319, 279, b"x", 0)
    yield "System V shared memory", call(29, 194, 0, 4096, 0o1600)
    yield "a message queue", call(68, 186, 0, 0o1600)
    yield "a semaphore", call(64, 190, 0, 1, 0o1600)
    yield "another execution domain", personality
    yield "a new root", call(161, 51, b"/")
    yield "an inotify", call(294, 26, 0)
