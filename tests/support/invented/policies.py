"""Small policies whose source changes as agents change theirs, and what came of each: invented."""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

POLICY = '''"""A proportional controller with a filtered error."""

import numpy as np

{imports}GAIN = {gain}
BIAS = {bias}


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.action_space = action_space
        self.filtered = 0.0
{init}
    def reset(self, episode_index):
        self.filtered = 0.0

    def act(self, obs):
        values = np.asarray(obs, dtype=np.float64).ravel()
        error = float(values.sum()) + BIAS
        self.filtered = {mix} * self.filtered + (1.0 - {mix}) * error
        command = GAIN * self.filtered
{body}        if self.action_space["type"] == "Discrete":
            return int(command > 0.0)
        return np.clip(np.full(self.action_space["shape"], command), -1.0, 1.0)
'''


def policy(
    *, gain: float = 0.5, bias: float = 0.0, mix: float = 0.9, integral: bool = False, planner: bool = False
) -> dict[str, str]:
    """Source files of a policy: two optional mechanisms over three constants."""
    init = body = imports = ""
    files: dict[str, str] = {}
    if integral:
        init += "        self.total = 0.0\n"
        body += "        self.total = max(-5.0, min(5.0, self.total + error))\n        command += 0.05 * self.total\n"
    if planner:
        imports = "from planner import lookahead\n\n"
        body += "        if abs(error) > 1.0:\n            command += lookahead(values)\n"
        files["planner.py"] = (
            '"""Looks a few steps ahead."""\n\n\ndef lookahead(values):\n    best = 0.0\n    for step in range(3):\n'
            "        for value in values:\n            if value * step > best:\n                best = value * step\n"
            "    return best\n"
        )
    text = POLICY.format(gain=gain, bias=bias, mix=mix, init=init, body=body, imports=imports)
    return {"policy.py": text, **files}


@dataclass
class Version:
    """One submit: the policy and what came of it."""

    files: Mapping[str, str]
    returns: Sequence[float] = (0.0,)
    val: float | None = None
    status: str = "ok"
    failed: Sequence[int] = ()
    images: Mapping[str, bytes] = field(default_factory=dict)
    says: str = ""
    """The agent's message before it, for the log."""


def png(seed: int = 0) -> bytes:
    """A small valid RGB image."""
    generator, width, height = random.Random(seed), 48, 32
    base = [generator.randrange(256) for _ in range(3)]
    rows = b"".join(
        b"\0" + b"".join(bytes(((c + 3 * x + 2 * y) % 256) for c in base) for x in range(width))
        for y in range(height)
    )

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
