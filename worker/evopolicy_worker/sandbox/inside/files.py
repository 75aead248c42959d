"""The sandbox's files: in a file system of its own in memory, instead of the machine's folders.

Processes that share a folder of the machine can pass messages through it, even long afterwards: the kernel caches which
names were looked up in it, including missing ones, and which files were read, and the time of another lookup reveals
this. In a file system in memory, all content is in memory, and missing names are not cached.

Standard library only: the sandbox shows nothing else.
"""

import ctypes
import glob
import os

MS_NOSUID, MS_NODEV, MS_RDONLY, MS_REMOUNT, MS_BIND, MS_REC = 2, 4, 1, 32, 4096, 16384
MNT_DETACH = 2
LARGE = 1 << 20
"""Files from this size on, bytes, are shown as they are, after they were read once: there are few, and no folder."""
LEFT_OUT = {"test", "tests", "idlelib", "turtledemo", "ensurepip", "site-packages", "dist-packages"}
LEFT_OUT_ENDINGS = (".opt-1.pyc", ".opt-2.pyc", ".a", ".exe", ".h", ".pyi")
LOADED_LATE = ("libgcc_s.so.1",)
"""Libraries that the C library loads by itself, when a thread is ended."""

libc = ctypes.CDLL(None, use_errno=True)


def check(result: int, what: str) -> None:
    if result < 0:
        raise OSError(ctypes.get_errno(), f"{what}: {os.strerror(ctypes.get_errno())}")


def take_over(folders: list[str], libraries: list[str], place: str) -> None:
    """Puts copies in place of `folders`, and of `libraries` (folders too) what the extension modules in `folders` need.

    `place`: an empty folder to work in.
    """
    flags = MS_NOSUID | MS_NODEV
    check(libc.mount(b"files", place.encode(), b"tmpfs", flags, b"mode=0755"), f"mount {place}")
    for folder in folders:
        copy_folder(folder, place + folder)
        bind(place + folder, folder)
    for library in needed(folders):
        if not os.path.exists(place + library):
            os.makedirs(place + os.path.dirname(library), mode=0o755, exist_ok=True)
            copy_file(library, place + library)
    for folder in libraries:
        os.makedirs(place + folder, mode=0o755, exist_ok=True)
    check(libc.mount(None, place.encode(), None, flags | MS_REMOUNT | MS_RDONLY, None), f"seal {place}")
    for folder in libraries:
        bind(place + folder, folder)
    check(libc.umount2(place.encode(), MNT_DETACH), f"umount {place}")


def bind(source: str, target: str) -> None:
    check(libc.mount(source.encode(), target.encode(), None, MS_BIND | MS_REC, None), f"bind {target}")


def copy_folder(source: str, target: str) -> None:
    os.makedirs(target, mode=0o755, exist_ok=True)
    with os.scandir(source) as entries:
        for entry in entries:
            to = f"{target}/{entry.name}"
            if entry.is_symlink():
                os.symlink(os.readlink(entry.path), to)
            elif entry.is_dir():
                if entry.name not in LEFT_OUT and not entry.name.startswith("config-"):
                    copy_folder(entry.path, to)
            elif entry.is_file() and not entry.name.endswith(LEFT_OUT_ENDINGS):
                copy_file(entry.path, to)


def copy_file(source: str, target: str) -> None:
    """With its time, by which Python knows whether compiled code is of this source. Leaves out unreadable
    files."""
    try:
        fd = os.open(source, os.O_RDONLY)
    except PermissionError:
        return
    with open(fd, "rb", buffering=0) as file:
        status = os.fstat(fd)
        with open(target, "wb", buffering=0) as copy:
            if status.st_size < LARGE:
                copy.write(file.readall())
            else:
                while file.read(LARGE):
                    pass
        if status.st_size < LARGE:
            os.utime(target, ns=(status.st_mtime_ns, status.st_mtime_ns))
            os.chmod(target, 0o755 if status.st_mode & 0o100 else 0o644)
        else:
            bind(source, target)


def needed(folders: list[str]) -> list[str]:
    """Paths of the shared libraries that extension modules in these folders load. Found by loading them, in a process
    that ends."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            modules = (
                path for folder in folders for path in glob.iglob(f"{folder}/**/*.so*", recursive=True)
            )
            for name in (*LOADED_LATE, *modules):
                try:
                    ctypes.CDLL(name)
                except OSError:
                    # One of its requirements is missing on this machine, so it cannot be imported here.
                    continue
            with open(write, "w") as file:
                file.write("\n".join(loaded()))
        finally:
            os._exit(0)
    os.close(write)
    with open(read) as file:
        paths = file.read().split("\n")
    os.waitpid(child, 0)
    return [
        path for path in paths if path.startswith("/") and not any(path.startswith(f"{f}/") for f in folders)
    ]


def loaded() -> list[str]:
    """Paths of the shared libraries in this process."""
    paths: list[str] = []

    class Information(ctypes.Structure):
        _fields_ = (("address", ctypes.c_void_p), ("name", ctypes.c_char_p))

    @ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(Information), ctypes.c_size_t, ctypes.c_void_p)
    def each(information, size, data):  # type: ignore[no-untyped-def]
        if information.contents.name:
            paths.append(os.fsdecode(information.contents.name))
        return 0

    libc.dl_iterate_phdr(each, None)
    return paths
