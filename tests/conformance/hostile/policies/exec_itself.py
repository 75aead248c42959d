"""Becomes another program: the interpreter once more, without the seal."""
import os, sys

def attempts():
    yield "exec", lambda: os.execv(sys.executable, [sys.executable, "-c", "print('THROUGH: exec', flush=True)"])
