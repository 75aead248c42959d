"""Traces, reads, and disturbs processes, and moves to another core."""
import ctypes, os, resource, signal
libc = ctypes.CDLL(None, use_errno=True)
X86 = os.uname().machine == "x86_64"

def call(x86, arm, *arguments):
    def run():
        if libc.syscall(x86 if X86 else arm, *arguments) < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        return True
    return run

def move():
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    return True

def attempts():
    yield "being traced", call(101, 117, 0, 0, 0, 0)
    yield "signal 0 to pid 2", lambda: os.kill(2, 0) is None
    yield "signal 0 to everyone", lambda: os.kill(-1, 0) is None
    yield "a queued signal to itself", call(129, 138, os.getpid(), 0, bytes(128))
    yield "setting its CPU affinity", move
    yield "limits of its parent", lambda: resource.prlimit(os.getppid() or 2, resource.RLIMIT_NOFILE)
    yield "memory of its own through process_vm_readv", call(310, 270, os.getpid(), None, 0, None, 0, 0)
    yield "comparing kernel objects", call(312, 272, os.getpid(), os.getpid(), 0, 0, 0)
