"""No policy sees the work that the zygote does once for all policies."""

from __future__ import annotations

import ctypes
import importlib.util
import json
import random
import struct
import sys
from types import ModuleType

import numpy as np
import pytest
from program_runs import run_python
from slots import HONEST, Slots, acting

from evopolicy_worker.sandbox.jail import INSIDE

SEES = acting(
    init="""
        streams = [[each.seekable(), each.line_buffering, each.encoding] for each in (sys.stdout, sys.stderr)]
        first = next(iter(sys.path))
        print(json.dumps([streams, first == os.getcwd(), os.environ["HOME"], os.environ["TMPDIR"],
            "LD_BIND_NOW" in os.environ, "PWD" in os.environ, random.random(), np.random.rand(),
            sorted(name for name in sys.modules if name.startswith("policy")),
            [sum(each.__name__ == "Policy" for each in object.__subclasses__()),
                sorted(os.listdir(os.environ["HOME"])), os.listdir("."), os.listdir(os.environ["TMPDIR"])]]))
    """,
    before="import io, json, os, random, sys; import numpy as np",
)


LOOKS = acting(
    init="""
        print(HERE, id(self), id(object()), sys.getallocatedblocks(), sys.getrefcount("a constant of this file"))
    """,
    before="""
        import gc, sys

        HERE = [id(object()), id([]), id({}), sys.getrefcount(None), sys.getallocatedblocks(), len(gc.get_objects())]
    """,
)


@pytest.fixture(scope="module")
def policy_server() -> ModuleType:
    spec = importlib.util.spec_from_file_location("_policy_server_here", INSIDE / "policy_server.py")
    assert spec is not None
    assert spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


@pytest.mark.parametrize("copies", [True, False])
@pytest.mark.parametrize(
    "seed",
    [
        bytes(range(16)),
        b"\xff" * 16,
        bytes(15) + b"\x01",
        # Words of zeros at the end, which a number does not have.
        b"\x01" + bytes(15),
        bytes(16),
        b"sixteen bytes and more",
    ],
)
def test_a_policys_generators_begin_as_numpy_seeds_them(
    policy_server: ModuleType, seed: bytes, copies: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = random.getstate(), np.random.get_state(), np.random.bit_generator.randbits  # type: ignore[attr-defined]
    try:
        policy_server.find_numpy_key()
        assert policy_server.numpy_key
        if not copies:
            monkeypatch.setattr(policy_server, "numpy_key", 0)
        policy_server.seed_generators(seed)
        found = np.random.standard_normal(3).tolist(), np.random.randint(1 << 30, size=3).tolist()
        np.random.seed(list(struct.unpack("<4I", seed[:16])))
        assert found == (np.random.standard_normal(3).tolist(), np.random.randint(1 << 30, size=3).tolist())
    finally:
        random.setstate(kept[0])
        np.random.set_state(kept[1])
        vars(np.random.bit_generator)["randbits"] = kept[2]


@pytest.mark.parametrize("tier", ["bwrap", "landlock", "none"])
def test_a_policy_finds_its_process_as_if_new(slots: Slots, tier: str) -> None:
    outcome = slots.play(SEES, tier=tier)
    assert outcome.failure is None
    streams, is_first, home, temporary, binds, has_pwd, drawn, numpys, modules, counts = json.loads(
        outcome.stdout
    )
    assert streams == [[False, True, "utf-8"]] * 2
    assert (is_first, temporary, binds, has_pwd) == (True, f"{home}/tmp", False, False)
    assert modules == ["policy"]
    # Nothing of the policy that the zygote imported.
    assert counts == [1, ["system", "tmp"], ["policy.py"], []]
    again = json.loads(slots.play(SEES, tier=tier).stdout)
    assert (drawn, numpys) == (again[6], again[7])


def test_all_policies_of_a_slot_load_the_same_code(slots: Slots) -> None:
    """The first could otherwise tell that it is the first: its memory would hold what the compiler leaves behind."""
    with slots.running() as slot:
        found = [slots.play(LOOKS, slot=slot).stdout for _ in range(3)]
    assert found[0]
    assert found == found[:1] * 3


@pytest.mark.parametrize(
    ("source", "category", "says"),
    [
        (HONEST + "\nassert 1 is 1\n", None, b"SyntaxWarning"),
        (HONEST + "\nthis is no Python\n", "import_error", b""),
        (HONEST + "\nx = " + "-" * 100_000 + "1\n", "import_error", b""),
        ("# coding: latin-1\n" + HONEST + "\nassert len('\u00e9') == 2\n", None, b""),
        (HONEST + "\nraise KeyError('here')\n", "import_error", b""),
    ],
)
def test_a_policy_is_compiled_alike_in_each_episode(
    slots: Slots, source: str, category: str | None, says: bytes
) -> None:
    first, second = slots.play_all(source, n=2)
    for outcome in (first, second):
        assert (outcome.failure and outcome.failure.category) == category
        assert says in outcome.stderr
    assert first.stderr == second.stderr
    if first.failure is not None and second.failure is not None:
        assert first.failure.message == second.failure.message
        assert first.failure.traceback == second.failure.traceback
        assert "importlib" not in first.failure.traceback


HEAP = """
import ctypes, importlib.util, sys
spec = importlib.util.spec_from_file_location("zygote", sys.argv[1])
zygote = importlib.util.module_from_spec(spec)
spec.loader.exec_module(zygote)
libc = zygote.libc
libc.sbrk.restype = libc.mmap.restype = ctypes.c_void_p
end = libc.sbrk(ctypes.c_long(0))
if sys.argv[2] == "blocked":
    page, flags = end + (8 << 20), 0x22 | zygote.MAP_FIXED_NOREPLACE
    assert libc.mmap(ctypes.c_void_p(page), ctypes.c_size_t(4096), 0, flags, -1, ctypes.c_long(0)) == page
with zygote.huge_pages():
    kept = [(k,) for k in range(400_000)]
print(sum(map(len, kept)), end < id(kept[-1]) < libc.sbrk(ctypes.c_long(0)))
"""


@pytest.mark.parametrize("room", ["free", "blocked"])
def test_pythons_memory_extends_the_heap_only_where_there_is_room(room: str) -> None:
    done = run_python(HEAP, INSIDE / "zygote.py", room)
    glibc = hasattr(ctypes.CDLL(None), "gnu_get_libc_version")
    extends = room == "free" and glibc and sys.version_info < (3, 14)
    assert (done.returncode, done.stdout) == (0, f"400000 {extends}\n"), done.stderr
