"""Starts processes in every possible way, including one that would outlive the episode."""
import ctypes, os, signal, subprocess
libc = ctypes.CDLL(None, use_errno=True)
X86 = os.uname().machine == "x86_64"

def fork():
    child = os.fork()
    if not child:
        os._exit(0)
    os.waitpid(child, 0)
    return child

def daemon():
    child = os.fork()
    if not child:
        os.setsid()
        import time
        time.sleep(0.5)  # bounded: with the defence off it must go by itself
        os._exit(0)
    return child

def clone(number, *arguments):
    child = libc.syscall(number, *arguments)
    if child == 0:
        os._exit(0)
    if child < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    os.waitpid(child, 0)
    return True

def attempts():
    yield "fork", fork
    yield "a daemon", daemon
    yield "a program", lambda: subprocess.run(["/bin/true"]).returncode == 0
    yield "posix_spawn", lambda: os.waitpid(os.posix_spawn("/bin/true", ["true"], {}), 0)
    yield "clone", lambda: clone(56 if X86 else 220, signal.SIGCHLD, 0, 0, 0, 0)
