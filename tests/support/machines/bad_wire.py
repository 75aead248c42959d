"""Carries packets between two TUN devices, late and not all of them: `python bad_wire.py NEAR FAR`.

For kernels without netem. Says `ready` once both devices are there; lines `DELAY_S LOSS` on stdin change the weather;
ends when stdin does. A packet keeps its place in the line: a shorter delay holds for what comes after it. Which packets
are lost is drawn from a fixed seed.
"""

from __future__ import annotations

import fcntl
import os
import random
import select
import struct
import sys
import time
from collections import deque

_TUNSETIFF = 0x400454CA
_IFF_TUN = 0x0001
_IFF_NO_PI = 0x1000
_PACKET_BYTES = 1 << 16


def open_device(name: str) -> int:
    """A new TUN device of this network namespace; it may be moved to another, and ends with the descriptor."""
    fd = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    fcntl.ioctl(fd, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TUN | _IFF_NO_PI))
    return fd


def carry(near: int, far: int, weather: int) -> None:
    """Carries until end of file on `weather`."""
    delay_s, loss = 0.0, 0.0
    draw = random.Random(0)
    under_way: deque[tuple[float, int, bytes]] = deque()
    other = {near: far, far: near}
    received = b""
    while True:
        wait_s = max(0.0, under_way[0][0] - time.monotonic()) if under_way else None
        readable, _, _ = select.select([near, far, weather], [], [], wait_s)
        if weather in readable:
            heard = os.read(weather, 4096)
            if not heard:
                return
            *lines, received = (received + heard).split(b"\n")
            for line in lines:
                delay_s, loss = (float(word) for word in line.split())
        now = time.monotonic()
        for device in (near, far):
            if device in readable:
                packet = os.read(device, _PACKET_BYTES)
                if draw.random() >= loss:
                    due = max(now + delay_s, under_way[-1][0] if under_way else 0.0)
                    under_way.append((due, other[device], packet))
        while under_way and under_way[0][0] <= now:
            _, device, packet = under_way.popleft()
            try:
                os.write(device, packet)
            except OSError:
                # The device is down, or its queue is full: a packet that is lost, as on any line.
                continue


if __name__ == "__main__":
    near, far = map(open_device, sys.argv[1:])
    print("ready", flush=True)
    carry(near, far, sys.stdin.fileno())
