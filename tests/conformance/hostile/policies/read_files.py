"""Reads files outside its own: the machine's files, the simulators, our code, by name, by link, and through parent folders."""
import json, os, sys
TARGET = json.load(open("target.json"))

def link():
    os.symlink(TARGET["secret_file"], "link")
    return open("link").read()

def hard_link():
    os.link(TARGET["secret_file"], "hard")
    return open("hard").read()

def attempts():
    yield "a file of the worker's", lambda: open(TARGET["secret_file"]).read()
    yield "the same by a symbolic link", link
    yield "the same upwards from here", lambda: open("../" * 20 + TARGET["secret_file"]).read()
    yield "the worker's code", lambda: open(TARGET["worker_code"]).read()
    yield "the simulators", lambda: os.listdir(TARGET["simulators"])
    yield "the users of the machine", lambda: open("/etc/passwd").read()
    yield "the host's name", lambda: open("/etc/hostname").read()
    yield "home folders", lambda: [
        name for folder in ("/home", "/root") for name in os.listdir(folder) if name not in ("policy", *sys.base_prefix.split("/"))]
    yield "the worker's environment", lambda: open(f"/proc/{os.getppid()}/environ", "rb").read()
    yield "its own maps", lambda: open("/proc/self/maps").read()
