"""The agent's one tool: a command in a new shell, with bounded time and bounded output."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import tempfile
from typing import Any, BinaryIO

NAME = "bash"
DESCRIPTION = (
    "Runs a command with bash in the working directory and returns its exit status and output (stdout and stderr"
    " together). Each call is a new shell: only files last. Long output is cut in the middle. Start nothing in the"
    " background."
)
USUAL_S, MOST_S = 600.0, 7200.0
"""Time of a command unless the model sets one, and the most that it can set, seconds."""
PARAMETERS: dict[str, Any] = {
    "type": "object",
    "properties": {
        "command": {"type": "string", "description": "What to run."},
        "timeout_s": {
            "type": "number",
            "description": f"Seconds after which it is ended; {USUAL_S:g} by default, {MOST_S:g} at most.",
        },
    },
    "required": ["command"],
}
_HALF_BYTES = 15_000
"""Bytes shown of an output's beginning and of its end."""


def run(command: str, timeout_s: float) -> tuple[str, bool]:
    """Returns the output for the model, and whether the command succeeded. `timeout_s`: seconds."""
    with tempfile.TemporaryFile() as output:
        try:
            process = subprocess.Popen(
                ["bash", "-c", command],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        except (OSError, ValueError) as error:  # too long for the kernel, or with a null byte
            return f"the command cannot be started: {error}", False
        try:
            code = process.wait(timeout_s)
            how = f"exit status {code}" if code >= 0 else f"ended by signal {-code}"
        except subprocess.TimeoutExpired:
            code = -1
            how = f"ended after {timeout_s:g} s; give a larger timeout_s to commands that take longer"
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return f"[{how}]\n{_shown(output)}", code == 0


def _shown(file: BinaryIO) -> str:
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    if size <= 2 * _HALF_BYTES:
        return file.read().decode("utf-8", "replace")
    head = file.read(_HALF_BYTES)
    file.seek(size - _HALF_BYTES)
    left_out = f"\n[{size - 2 * _HALF_BYTES:,} bytes left out]\n"
    return head.decode("utf-8", "replace") + left_out + file.read().decode("utf-8", "replace")
