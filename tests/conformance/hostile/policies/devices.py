"""Probes devices and the kernel's file systems."""
import os

def attempts():
    yield "kernel messages", lambda: os.open("/dev/kmsg", os.O_RDONLY | os.O_NONBLOCK)
    yield "other devices", lambda: set(os.listdir("/dev")) - {"null", "full", "random", "urandom"}
    yield "/sys", lambda: os.listdir("/sys")
    yield "the machine's memory", lambda: open("/proc/meminfo").read()
    yield "cgroups", lambda: os.listdir("/sys/fs/cgroup")
    yield "the boot's identity", lambda: open("/proc/sys/kernel/random/boot_id").read()
