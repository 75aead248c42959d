"""With scipy allowed: C callbacks, files in its formats, its worker pools, f2py, neighbouring packages."""

import contextlib
import ctypes
import importlib.util
import io
import json
import os
import sys

import numpy as np
import scipy.io
from numpy.f2py import f2py2e
from scipy import LowLevelCallable, ndimage, optimize

TARGET = json.load(open("target.json"))
SIGNATURE = "int (double *, npy_intp, double *, void *)"
libc = ctypes.CDLL(None)


def called(name):
    """scipy's C code calls this function of the C library, once: with a pointer to a zero, the number 1, and two pointers."""
    function = libc[name]
    function.restype = ctypes.c_int
    function.argtypes = [
        ctypes.POINTER(ctypes.c_double),
        ctypes.c_ssize_t,
        ctypes.POINTER(ctypes.c_double),
        ctypes.c_void_p,
    ]
    with contextlib.suppress(RuntimeError):
        ndimage.generic_filter(np.zeros(1), LowLevelCallable(function, signature=SIGNATURE), size=1)


def forked():
    parent = os.getpid()
    try:
        called("fork")
    finally:
        if os.getpid() != parent:
            os._exit(0)
    return os.waitpid(-1, 0)[0] > 0


def memory():
    def next_descriptor():
        fd = os.dup(1)
        os.close(fd)
        return fd

    before = next_descriptor()
    called("memfd_create")
    return next_descriptor() > before


def square(x):
    return float(x[0] ** 2)


def compiled():
    with open("made.f", "w") as file:
        file.write("      subroutine made\n      end\n")
    sys.argv = ["f2py", "-c", "-m", "made", "made.f"]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        f2py2e.run_compile()
    return True


def recording(name):
    return os.path.join(TARGET["recordings"], name)


def written():
    path = os.path.join(os.path.dirname(scipy.__file__), "evopolicy-was-here.mat")
    scipy.io.savemat(path, {"seen": 7})
    os.unlink(path)
    return True


def beside():
    folder = os.path.dirname(os.path.dirname(os.path.realpath(scipy.__file__)))
    return [name for name in os.listdir(folder) if name.partition(".")[0] not in ("numpy", "scipy")]


def simulator():
    sys.path.append(os.path.dirname(os.path.dirname(os.path.realpath(scipy.__file__))))
    return importlib.util.find_spec("gymnasium") is not None


def attempts():
    yield "a process by a C function that scipy calls", forked
    yield "memory without a file by a C function that scipy calls", memory
    yield (
        "a worker pool",
        lambda: optimize.brute(square, (slice(0, 1, 0.5),), workers=2, finish=None) is not None,
    )
    yield "a compiler by f2py", compiled
    yield (
        "a file of the worker's in MATLAB's format",
        lambda: "seed" in scipy.io.loadmat(recording("secret.mat")),
    )
    yield "a sound of the worker's", lambda: len(scipy.io.wavfile.read(recording("secret.wav"))) == 2
    yield "a matrix of the worker's", lambda: scipy.io.mminfo(recording("secret.mtx"))[0] == 2
    yield (
        "a file of the worker's as a Fortran one",
        lambda: len(scipy.io.FortranFile(TARGET["secret_file"])._fp.read()) > 0,
    )
    yield "scipy's folder", written
    yield "the packages beside it", lambda: len(beside()) > 0
    yield "a simulator beside it", simulator
