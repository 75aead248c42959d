"""Two policies in parallel slots try to find each other: one leaves a sign, the other looks for it."""
import ctypes, fcntl, json, os, socket, time
TARGET = json.load(open("target.json"))
LIBRARY = os.path.join(os.path.dirname(os.__file__), "this.py")

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

def attempts():
    yield {"files": ("in /tmp", file("/tmp/evopolicy-talk")), "shm": ("in shared memory", file("/dev/shm/evopolicy-talk")),
           "abstract": ("abstract socket", abstract), "lock": ("a lock on a shared file", lock),
           "record": ("a record lock on a shared file", record_lock)}[TARGET["way"]]
