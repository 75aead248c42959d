"""Replaces itself by another program: a new interpreter without the filter."""
import os, sys

def attempts():
    yield "exec", lambda: os.execv(sys.executable, [sys.executable, "-c", "print('THROUGH: exec', flush=True)"])
