"""`--web`: the live view of a command's runs, in its own process that ends with the command."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

from evopolicy_common.errors import ConfigError
from evopolicy_common.processes.child_process import ChildProcess, last_words
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_common.terminal import say

_START_TIMEOUT_S = 60.0
_POLL_S = 0.05
_GRACE_S = 5.0


@contextlib.asynccontextmanager
async def live_view(root: Path, connect: Sequence[str], file: Path | None) -> AsyncIterator[None]:
    """Shows the runs in `root` and the cluster inside the `async with`; prints the URL.

    Raises ConfigError when the view does not start.
    """
    root.mkdir(parents=True, exist_ok=True)
    with scratch_folder("view") as folder:
        address, log = folder / "address", folder / "view.log"
        program = [sys.executable, "-P", "-m", "evopolicy_gateway.cli", "web", str(root)]
        program += ["--http", "127.0.0.1:0", "--url-file", str(address)]
        for endpoint in connect:
            program += ["--connect", endpoint]
        if file is not None:
            program += ["--credentials", str(file)]
        child = await ChildProcess.start(program, log)
        try:
            try:
                async with asyncio.timeout(_START_TIMEOUT_S):
                    while not address.exists():
                        if child.exit_code is not None:
                            raise ConfigError(f"--web: {last_words(log) or 'the view ended at its start'}")
                        await asyncio.sleep(_POLL_S)
            except TimeoutError as error:
                raise ConfigError(
                    f"--web: the view did not start within {_START_TIMEOUT_S:g} s; leave out --web, and start it with"
                    f" `evopolicy web {root}`"
                ) from error
            say(f"view: {address.read_text()}", err=True)
            address.unlink()  # it holds the token, and an agent without a jail can read this user's files
            yield
        finally:
            await child.end(_GRACE_S)
