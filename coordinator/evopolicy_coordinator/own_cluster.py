"""A cluster of this machine's own for as long as a command runs: a coordinator first, a worker when it is wanted.

Both are child processes that get SIGTERM when this one dies. What they say goes to files under the state folder.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

import msgspec

from evopolicy_common.errors import ConfigError
from evopolicy_common.scratch import scratch_folder
from evopolicy_coordinator.process import Ready

START_PATIENCE_S = 60.0
END_GRACE_S = 10.0

_LEASHED = (
    "import ctypes, os, sys; ctypes.CDLL(None).prctl(1, 15, 0, 0, 0);"
    " os.getppid() == int(sys.argv[1]) or sys.exit(1); os.execv(sys.argv[2], sys.argv[2:])"
)
"""Asks for SIGTERM at the parent's death, which survives exec, and becomes the program."""


class OwnCluster:
    """A running coordinator's whereabouts, and the means to give it a worker."""

    def __init__(self, root: Path, ready: Ready, children: list[asyncio.subprocess.Process]) -> None:
        self.operator_file = Path(ready.credentials["operator"])
        self._root = root
        self._worker_file = ready.credentials["worker"]
        self._children = children

    async def start_worker(self, env: str, slots: int) -> asyncio.Task[None]:
        """Starts a worker that offers `env`; the task ends only with the ConfigError that says why it ended."""
        # Who starts this cluster is the one who chooses the tiers of what it plays.
        program = [
            "evopolicy_worker.cli",
            "--slots",
            str(slots),
            "--grace",
            "1",
            "--unsandboxed",
            "--env",
            env,
        ]
        log = self._root / "logs" / "verify-worker.log"
        child = await _start([*program, "--credentials", self._worker_file], log)
        self._children.append(child)
        return asyncio.create_task(_ended(child, log))


@contextlib.asynccontextmanager
async def own_cluster(*, state: Path | None = None, data: Path | None = None) -> AsyncIterator[OwnCluster]:
    """A coordinator inside the `async with`, with its workers taken down at its end.

    `state` None: a folder that is thrown away. ConfigError when it does not come up (the folder may be in use).
    """
    with contextlib.ExitStack() as folders:
        if state is None:
            root = folders.enter_context(scratch_folder("verify"))
        elif state.is_dir():
            root = state
        else:
            raise ConfigError(f"--state {state}: there is no such state folder")
        ready_file = root / f"verify-{os.getpid()}.json"
        folders.callback(ready_file.unlink, missing_ok=True)
        log = root / "logs" / "verify-coordinator.log"
        program = ["evopolicy_coordinator.cli", "--state", str(root), "--ready-file", str(ready_file)]
        if data is not None:
            program += ["--data", str(data.absolute())]
        children: list[asyncio.subprocess.Process] = []
        try:
            children.append(await _start(program, log))
            yield OwnCluster(root, await _ready(ready_file, children[0], log), children)
        finally:
            # The worker first: it hands back what it holds.
            for child in reversed(children):
                await _end(child)


async def _start(program: Sequence[str], log: Path) -> asyncio.subprocess.Process:
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as out:
        return await asyncio.create_subprocess_exec(
            *(sys.executable, "-I", "-S", "-c", _LEASHED, str(os.getpid())),
            *(sys.executable, "-P", "-m", *program),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=out,
            start_new_session=True,  # Ctrl-C reaches the command alone, which then ends them in order
        )


async def _ready(ready_file: Path, child: asyncio.subprocess.Process, log: Path) -> Ready:
    try:
        async with asyncio.timeout(START_PATIENCE_S):
            while not ready_file.exists():
                if child.returncode is not None:
                    await _ended(child, log)
                await asyncio.sleep(0.02)
    except TimeoutError as error:
        raise ConfigError(f"the local coordinator did not start within {START_PATIENCE_S:g} s") from error
    return msgspec.json.decode(ready_file.read_bytes(), type=Ready)


async def _ended(child: asyncio.subprocess.Process, log: Path) -> None:
    code = await child.wait()
    lines = log.read_text("utf-8", "replace").strip().splitlines()
    said = lines[-1].removeprefix("error: ") if lines else "it said nothing"
    raise ConfigError(f"{log.stem.removeprefix('verify-')} ended with status {code}: {said}")


async def _end(child: asyncio.subprocess.Process) -> None:
    with contextlib.suppress(ProcessLookupError):
        child.terminate()
    try:
        async with asyncio.timeout(END_GRACE_S):
            await child.wait()
    except TimeoutError:
        with contextlib.suppress(ProcessLookupError):
            child.kill()
        await child.wait()
