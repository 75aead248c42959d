"""Makes the system calls that only sandboxes and attackers need."""
import ctypes, os, struct
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

def prctl(option, value):
    def run():
        if libc.prctl(option, value, 0, 0, 0) < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        return True
    return run

def cached():
    fd = os.open(os.__file__, os.O_RDONLY)
    os.read(fd, 100)
    return os.preadv(fd, [bytearray(10)], 0, os.RWF_NOWAIT)

def woken():
    libc.mmap.restype = ctypes.c_void_p
    page = libc.mmap(None, ctypes.c_size_t(4096), 1, 1, os.open(os.__file__, os.O_RDONLY), ctypes.c_long(0))
    if libc.syscall(202 if X86 else 98, ctypes.c_void_p(page), 1, 1, None, None, 0) < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return True

def clone3(flags):
    # Tried out and over: it ends at once, and its parent buries it.
    child = libc.syscall(435, struct.pack("<11Q", flags, 0, 0, 0, 17, 0, 0, 0, 0, 0, 0), 88)
    if child == 0:
        os._exit(0)
    if child < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    os.waitpid(child, 0)
    return True

def filtered():
    # One instruction that allows everything.
    code = ctypes.create_string_buffer(struct.pack("<HBBI", 6, 0, 0, 0x7FFF0000))
    if libc.syscall(317 if X86 else 277, 1, 0, struct.pack("<H6xQ", 1, ctypes.addressof(code))) < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
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
    yield "the machine's memory and load", call(99, 179, ctypes.create_string_buffer(256))
    yield "what of a file is in memory", cached
    yield "who waits for a page of a shared file", woken
    yield "outliving its parent", prctl(1, 0)
    yield "being looked into by others", prctl(0x59616D61, -1)
    yield "a process in new namespaces", lambda: clone3(0x7E020000)
    yield "a new root", call(161, 51, b"/")
    yield "an inotify", call(294, 26, 0)
    yield "joining those whom a barrier on all cores interrupts", call(324, 283, 4, 0, 0)
    yield "a barrier on all cores", call(324, 283, 2, 0, 0)
    yield "watches that no limit counts", call(291, 20, 0)
    yield "watches by the older call", call(213, 20, 1)
    yield "an inotify by the older call", call(253, 26, 0)
    yield "watches of file systems", call(300, 262, 0, 0)
    yield "a descriptor of signals", call(289, 74, -1, bytes(8), 8, 0)
    yield "a timer of the kernel's", call(222, 107, 0, None, ctypes.create_string_buffer(8))
    yield "a queue of reads", call(206, 0, 8, ctypes.create_string_buffer(8))
    yield "a queue of messages with a name", call(240, 180, b"evopolicy", 0o102, 0o600, None)
    yield "rules of Landlock", call(444, 444, bytes([1] + [0] * 7), 8, 0)
    yield "a filter of system calls", filtered
    yield "a pipe", os.pipe
    yield "a pair of sockets", lambda: __import__("socket").socketpair()
