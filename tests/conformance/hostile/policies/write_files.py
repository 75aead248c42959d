"""Writes to protected places: the interpreter, the packages, the devices, the root."""
import os, sys
import numpy

def write(folder):
    def run():
        path = os.path.join(folder, "evopolicy-was-here")
        with open(path, "w") as file:
            file.write("x")
        os.unlink(path)
        return True
    return run

def attempts():
    yield "the standard library", write(os.path.dirname(os.__file__))
    yield "numpy's folder", write(os.path.dirname(numpy.__file__))
    yield "shared memory", write("/dev/shm")
    yield "the devices", write("/dev")
    yield "the root", write("/")
