"""Acts beyond its process through its open descriptors: owners, signals, leases, watches, larger pipes"""
import ctypes, fcntl, os
libc = ctypes.CDLL(None, use_errno=True)

def control(fd, command, argument):
    def run():
        result = libc.fcntl(fd if isinstance(fd, int) else fd(), command, argument)
        if result < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        return True
    return run

def own_file():
    return os.open("own", os.O_RDONLY | os.O_CREAT, 0o600)

def folder():
    return os.open(".", os.O_RDONLY | os.O_DIRECTORY)

def attempts():
    yield "signals to its reader", control(4, fcntl.F_SETOWN, os.getpid())
    yield "another signal than SIGIO", control(4, 10, 9)
    yield "a larger pipe", control(4, 1031, 1 << 20)
    yield "a lease on a file", control(own_file, fcntl.F_SETLEASE, fcntl.F_RDLCK)
    yield "a watch on a folder", control(folder, fcntl.F_NOTIFY, fcntl.DN_CREATE)
    yield "a lock on a file", lambda: fcntl.flock(own_file(), fcntl.LOCK_EX) is None
    yield "a lock on a record", lambda: fcntl.lockf(os.open("own", os.O_RDWR), fcntl.LOCK_EX) is None
