"""A simulator is other people's code: what one finds that takes whatever it can reach from an environment process.

Attacks, each with its defence:
- reads the supervisor's variables, memory, files or limits: a process namespace of its own; Landlock and the
  filter.
- signals or traces the supervisor: its process namespace; Landlock and the filter.
- connects to the coordinator's socket, to a port or an abstract socket of this machine: a network of its own;
  the filter.
- plants code in site-packages, the standard library, our code, or itself; leaves files in `/dev/shm` or
  `/tmp`: read-only mounts; private folders.
- reads the login's keyring, makes a namespace, mounts: the filter.
- forks, and lets the fork continue with the pipes of its process: a fork that returns from a call is ended.
"""

from __future__ import annotations

import asyncio
import ctypes
import json
import os
import secrets
import shutil
import socket
import sysconfig
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from slots import Slots, make_job

import evopolicy_worker
from evopolicy_common.errors import WorkerError
from evopolicy_common.messages.episode import Tier
from evopolicy_worker.sandbox import env_jail
from evopolicy_worker.slots.slot import Slot

SIMULATORS = Path(__file__).with_name("simulators")
ENV = "gymnasium/MiniGrid-FourRooms-v0"
ALLOWED = ("writes into its scratch folder", "writes into a temporary folder", "starts a program")
NOT_OF_THE_MACHINE = ("makes a namespace", "mounts", "reads the session keyring")
"""What the control may not be able to do either, for reasons of this machine's."""
FOR_ROOT = ("reads the supervisor's memory", "writes into the standard library")
"""What an ordinary user's process may not do either: permissions of the kernel and of files refuse it."""


@pytest.fixture
def targets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """A worker's surroundings, each with something in it, and the simulator that is told where they are."""
    state, bundles, other, home = (tmp_path / name for name in ("state", "bundles", "slot-other", "home"))
    for folder in (state, bundles, other, home):
        folder.mkdir(mode=0o700)
    (state / "worker.json").write_text("a token")
    (other / "notes").write_text("another slot's")
    (bundles / "policy.py").write_text("another run's")
    monkeypatch.setenv("EVOPOLICY_SECRET", "a token")
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "simulators"))
    shutil.copytree(SIMULATORS, tmp_path / "simulators")
    memory = ctypes.create_string_buffer(b"a token!")
    name = f"evopolicy-{secrets.token_hex(8)}"
    left = f"evopolicy-left-{os.getpid()}"
    open_sockets = [
        socket.create_server(("127.0.0.1", 0)),
        _listening(str(state / "s")),
        _listening(f"\0{name}"),
    ]
    for listener in open_sockets:
        threading.Thread(target=_greet, args=(listener,), daemon=True).start()
    found = {
        "credentials": str(state / "worker.json"),
        "state": str(state),
        "home": str(home),
        "supervisor": os.getpid(),
        "group": os.getpgid(0),
        "address": ctypes.addressof(memory),
        "port": open_sockets[0].getsockname()[1],
        "socket": str(state / "s"),
        "abstract": name,
        "site": sysconfig.get_path("purelib"),
        "worker_code": evopolicy_worker.__path__[0],
        "other_scratch": str(other / "notes"),
        "bundles": str(bundles),
        "left": left,
    }
    (tmp_path / "simulators" / "minigrid" / "TARGETS.json").write_text(json.dumps(found))
    yield found
    for listener in open_sockets:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
    planted = [Path(found["site"]), Path(found["worker_code"]), Path(os.__file__).parent]
    for path in [
        *(folder / "evopolicy_planted.py" for folder in planted),
        Path("/tmp", left),
        Path("/dev/shm", left),
    ]:
        path.unlink(missing_ok=True)
    del memory


def _listening(address: str) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(address)
    listener.listen()
    return listener


def _greet(listener: socket.socket) -> None:
    while True:
        try:
            link, _ = listener.accept()
        except OSError:
            return
        with link:
            link.sendall(b"reached")


def attempts(slots: Slots, tier: Tier) -> dict[str, str]:
    """What came of each."""

    async def play() -> str:
        slot = slots.new(tier)
        try:
            await slot.start()
            with pytest.raises(WorkerError) as caught:
                await slot.play_job(
                    make_job(env=ENV, bundle=None, tier=tier), None, lambda episodes, steps: None
                )
            return str(caught.value)
        finally:
            await slot.close()

    found: dict[str, str] = json.loads(slots.run(play()).removeprefix("RuntimeError: "))
    return found


@pytest.mark.parametrize("tier", ["bwrap", "landlock"])
def test_a_hostile_simulator_gets_nothing(tier: Tier, slots: Slots, targets: dict[str, Any]) -> None:
    """Attack: reads the worker's credentials, the state folder, the home folder, other slots' scratch
    folders or bundles, itself or by a program that it starts. Defence: not in its file system."""
    found = attempts(slots, tier)
    reached = {name: what for name, what in found.items() if what.startswith("got") and name not in ALLOWED}
    assert reached == {}
    assert {name for name in ALLOWED if not found[name].startswith("got")} == set()
    assert not Path("/dev/shm", targets["left"]).exists()
    assert not Path("/tmp", targets["left"]).exists()


def test_without_a_jail_the_same_simulator_gets_it_all(slots: Slots, targets: dict[str, Any]) -> None:
    found = attempts(slots, "none")
    refused = {name: what for name, what in found.items() if not what.startswith("got")}
    machine = NOT_OF_THE_MACHINE if os.geteuid() == 0 else NOT_OF_THE_MACHINE + FOR_ROOT
    assert refused.keys() - {*machine, "reads the supervisor's variables"} == set()
    assert "LookupError" in found["reads the supervisor's variables"]
    assert Path("/tmp", targets["left"]).exists()


@pytest.mark.parametrize("tier", ["bwrap", "landlock"])
def test_a_simulator_that_prints_or_sends_out_of_turn_ends_its_slot(
    tier: Tier, slots: Slots, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attack: sends garbage in place of the environment process. Defence: the slot is restarted."""
    package = tmp_path / "simulators" / "minigrid"
    package.mkdir(parents=True)
    monkeypatch.setenv("PYTHONPATH", str(package.parent))
    (package / "__init__.py").write_text(
        "import os\nfor fd in range(3, 64):\n    try:\n        os.write(fd, b'\\x08\\0\\0\\0nonsense')\n    except"
        " OSError:\n        pass\nimport time; time.sleep(60)"
    )

    async def play() -> None:
        slot: Slot = slots.new(tier)
        await slot.start()
        with pytest.raises(WorkerError, match="cannot be read"):
            await asyncio.wait_for(
                slot.play_job(make_job(env=ENV, bundle=None, tier=tier), None, lambda episodes, steps: None),
                60,
            )
        await slot.close()

    slots.run(play())


def test_graphics_devices_are_there_for_videos_only(
    slots: Slots, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # In place of a graphics card's, which few machines of ours have.
    monkeypatch.setattr(env_jail, "_GRAPHICS", ("/dev/ptm[x]", "/dev/nvidia*"))
    package = tmp_path / "simulators" / "minigrid"
    package.mkdir(parents=True)
    monkeypatch.setenv("PYTHONPATH", str(package.parent))
    (package / "__init__.py").write_text("import os; os.stat('/dev/ptmx'); raise RuntimeError('it draws')")

    async def play(slot: Slot, video: bool) -> str:
        job = make_job(env=ENV, bundle=None, video=video)
        with pytest.raises(WorkerError) as caught:
            await slot.play_job(job, None, lambda episodes, steps: None)
        return str(caught.value)

    slot = slots.new()
    slots.run(slot.start())
    assert "it draws" not in slots.run(play(slot, False))
    assert "it draws" in slots.run(play(slot, True))
    slots.run(slot.close())
