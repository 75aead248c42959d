"""Changes or reads machine-wide numbers of the kernel: inodes, free blocks, mounts, huge pages"""
import ctypes, errno, mmap, os, struct
libc = ctypes.CDLL(None, use_errno=True)
libc.mmap.restype = ctypes.c_void_p
X86 = os.uname().machine == "x86_64"
HUGETLB = 0x40000

def call(number, *arguments):
    result = libc.syscall(number, *arguments)
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result

def pipe(number, *flags):
    def run():
        ends = (ctypes.c_int * 2)()
        call(number, ends, *flags)
        return os.fstat(ends[0]).st_ino
    return run

def mount_id(mask):
    def run():
        answer = ctypes.create_string_buffer(256)
        call(332 if X86 else 291, -100, b"/", 0, mask, answer)
        return struct.unpack_from("<Q", answer, 0x90)[0]
    return run

def huge_page():
    try:
        return mmap.mmap(-1, 2 << 20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | HUGETLB)
    except OSError as error:
        # Where the machine keeps none: there is nothing to be counted.
        return error.errno != errno.ENOMEM

def zero():
    return mmap.mmap(os.open("/dev/zero", os.O_RDWR), 4096, flags=mmap.MAP_SHARED)

def attempts():
    if X86:
        yield "the number of a pipe, the old way", pipe(22)
    yield "the number of a pipe", pipe(293 if X86 else 59, 0)
    yield "free blocks of the machine's disk", lambda: os.statvfs(os.__file__).f_bfree or True
    yield "free blocks of its own files", lambda: os.statvfs(".").f_bfree or True
    yield "free blocks by an open file", lambda: os.fstatvfs(os.open(os.__file__, os.O_RDONLY)).f_bfree or True
    yield "the number of a mount", mount_id(0x1000)
    yield "how many mounts there have ever been", mount_id(0x4000)
    yield "the number of a mount, asked for nothing", mount_id(0)
    yield "shared memory without a file", lambda: mmap.mmap(-1, 4096)
    yield "shared memory of a device", zero
    yield "a huge page", huge_page
