"""Two policies in parallel slots try to find each other: one leaves a sign, the other looks for it."""
import ctypes, fcntl, json, os, socket, struct, time
TARGET = json.load(open("target.json"))
LIBRARY = os.path.join(os.path.dirname(os.__file__), "this.py")
LIBRARY_FD = os.open(LIBRARY, os.O_RDONLY)
libc = ctypes.CDLL(None, use_errno=True)

def file(path):
    def run():
        if TARGET["role"] == "tell":
            open(path, "w").write("hello")
            time.sleep(1.0)
            os.unlink(path)
            return None
        return seen(lambda: os.path.exists(path))
    return run

def seen(look):
    end = time.monotonic() + 0.8
    while time.monotonic() < end:
        if look():
            return True
        time.sleep(0.01)
    return False

def abstract():
    s = socket.socket(socket.AF_UNIX)
    if TARGET["role"] == "tell":
        s.bind("\0evopolicy-talk")
        s.listen()
        time.sleep(1.0)
        return None
    return seen(lambda: s.connect_ex("\0evopolicy-talk") == 0)

def lock():
    fd = os.open(LIBRARY, os.O_RDONLY)
    if TARGET["role"] == "tell":
        fcntl.flock(fd, fcntl.LOCK_EX)
        time.sleep(1.0)
        return None
    def taken():
        try:
            fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        fcntl.flock(fd, fcntl.LOCK_UN)
        return False
    return seen(taken)

def record_lock():
    fd = os.open(LIBRARY, os.O_RDONLY)
    import struct
    if TARGET["role"] == "tell":
        fcntl.lockf(fd, fcntl.LOCK_SH)
        time.sleep(1.0)
        return None
    ask = struct.pack("hhqqi4x", fcntl.F_WRLCK, 0, 0, 0, 0)
    return seen(lambda: struct.unpack("hhqqi4x", fcntl.fcntl(fd, fcntl.F_GETLK, ask))[0] != fcntl.F_UNLCK)

def page():
    libc.mmap.restype = ctypes.c_void_p
    word = struct.unpack("<I", os.pread(LIBRARY_FD, 4, 0))[0]
    return ctypes.c_void_p(libc.mmap(None, ctypes.c_size_t(4096), 1, 1, LIBRARY_FD, ctypes.c_long(0))), word

def futex():
    # The page is the same one for all who map this file, and so is the queue of those that wait on it.
    address, word = page()
    number = 202 if os.uname().machine == "x86_64" else 98
    if TARGET["role"] == "tell":
        end = time.monotonic() + 1.0
        while time.monotonic() < end:
            libc.syscall(number, address, 1, 1, None, None, 0)
            time.sleep(0.01)
        return None
    pause = struct.pack("<qq", 0, 800_000_000)
    return libc.syscall(number, address, 0, ctypes.c_uint(word), pause, None, 0) == 0

def device():
    if TARGET["role"] == "tell":
        time.sleep(0.3)
        os.utime("/dev/null")
        return None
    before = os.stat("/dev/null").st_mtime
    return seen(lambda: os.stat("/dev/null").st_mtime != before)

def queued(most):
    # Signals that wait are counted for a user, whose processes all policies' are outside.
    mask, sent = ctypes.create_string_buffer(struct.pack("<Q", 1 << 39)), 0
    libc.sigprocmask(0, ctypes.create_string_buffer(mask.raw[:8].ljust(128, b"\0")), None)
    number = 234 if os.uname().machine == "x86_64" else 131
    while sent < most and libc.syscall(number, os.getpid(), os.getpid(), 40) == 0:
        sent += 1
    return sent

def taken_back():
    import signal
    while signal.sigtimedwait([40], 0) is not None:
        pass

def signals():
    if TARGET["role"] == "tell":
        queued(200)
        time.sleep(1.0)
        return None
    def missing():
        room = queued(240)
        taken_back()
        return room < 240
    return seen(missing)

def attempts():
    yield {"files": ("in /tmp", file("/tmp/evopolicy-talk")), "shm": ("in shared memory", file("/dev/shm/evopolicy-talk")),
           "abstract": ("abstract socket", abstract), "lock": ("a lock on a shared file", lock),
           "futex": ("who waits on a page of a shared file", futex), "device": ("a device's times", device),
           "record": ("a record lock on a shared file", record_lock),
           "signals": ("how many signals may wait", signals)}[TARGET["way"]]
