"""Child processes of a command."""

from __future__ import annotations

import asyncio
import gc
import logging
import sys
from pathlib import Path

import pytest

from evopolicy_common.processes.child_process import ChildProcess


def test_a_child_that_ends_with_unread_input_is_not_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def drained_again_and_again(stdin: asyncio.StreamWriter) -> None:
        while True:
            await stdin.drain()
            await asyncio.sleep(0.01)

    async def play() -> None:
        # The first write fills the pipe, and the rest waits in this process when the child ends.
        child = await ChildProcess.start([sys.executable, "-c", "input()"], tmp_path / "log", talks=True)
        stdin = child._process.stdin
        assert stdin is not None
        stdin.write(b"x" * (4 << 20))
        child._process.kill()
        await child.ended()
        with pytest.raises(ConnectionError):
            await drained_again_and_again(stdin)

    with caplog.at_level(logging.ERROR, "asyncio"):
        asyncio.run(play())
        gc.collect()
    assert caplog.text == ""
