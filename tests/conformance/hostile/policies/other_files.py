"""Changes files that are not the policy's without opening them for writing: modes, times, lengths"""
import os, json
TARGET = json.load(open("target.json"))
FILE = TARGET["own_file"]

def changed(what, change):
    def run():
        before = look(what)
        change()
        return look(what) != before
    return run

def look(what):
    return getattr(os.stat(FILE), what)

def attempts():
    yield "a file's mode", changed("st_mode", lambda: os.chmod(FILE, 0o646))
    yield "a file's times", changed("st_mtime", lambda: os.utime(FILE, (7, 7)))
    yield "a file's length", changed("st_size", lambda: os.truncate(FILE, 3))
    yield "a file's length by opening it", changed("st_size", lambda: os.open(FILE, os.O_RDONLY | os.O_TRUNC))
    yield "another name for it", lambda: os.rename(FILE, FILE + "-moved") or os.rename(FILE + "-moved", FILE) or True
    yield "times of a device", changed_device

def changed_device():
    before = os.stat("/dev/full").st_mtime
    os.utime("/dev/full")
    return os.stat("/dev/full").st_mtime != before
