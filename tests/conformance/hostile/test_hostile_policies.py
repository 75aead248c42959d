"""Every attack of the corpus gets its verdict, the slot plays honestly afterwards, and each is seen to succeed
undefended."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import random
import socket
import threading
import zlib
from collections.abc import Callable, Iterable, Iterator
from importlib.machinery import (
    EXTENSION_SUFFIXES,
    SOURCE_SUFFIXES,
    ExtensionFileLoader,
    FileFinder,
    SourceFileLoader,
)
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from breakers import BREAKERS, PATIENT, Breaker
from corpus import NO_SANDBOX, POLICIES, PROBE, PROBES, Probe, document
from slots import HONEST, Slots, acting, category_of, make_job, misbehaving, rows
from undefended import harmed

import evopolicy_worker
from evopolicy_common.errors import WorkerError
from evopolicy_common.messages.episode import EpisodeOutcome

pytestmark = pytest.mark.slow

SEED = 1_987_654_321
PACKAGES = [(), ("scipy",)]
"""Packages that policies may import besides numpy: a run's `--policy-package`."""
RECORDINGS: dict[str, Callable[[str], object]] = {
    "secret.mat": lambda path: scipy.io.savemat(path, {"seed": 7}),
    "secret.wav": lambda path: scipy.io.wavfile.write(path, 8000, np.zeros(8, dtype=np.int16)),
    "secret.mtx": lambda path: scipy.io.mmwrite(path, np.eye(2)),
}
"""Files of the worker's that scipy reads."""


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """The targets of attacks, all on this machine's loopback."""
    folder = tmp_path_factory.mktemp("target")
    secret = folder / "seeds.json"
    secret.write_text("the hidden seeds")
    for name, write in RECORDINGS.items():
        write(str(folder / name))
    own = folder / "own"
    own.write_text("a file of the worker's user")
    site = Path(pytest.__file__).parents[1]
    listeners = []
    tcp = socket.create_server(("127.0.0.1", 0))
    unix = socket.socket(socket.AF_UNIX)
    unix.bind(str(folder / "listener"))
    abstract = socket.socket(socket.AF_UNIX)
    abstract.bind(f"\0evopolicy-{folder.name}-{id(folder)}")
    for listener in (tcp, unix, abstract):
        listener.listen()
        listeners.append(listener)
        threading.Thread(target=serve, args=(listener,), daemon=True).start()
    yield {
        "secret_file": str(secret),
        "own_file": str(own),
        "recordings": str(folder),
        "worker_code": evopolicy_worker.__file__,
        "simulators": str(site / "gymnasium"),
        "tcp": tcp.getsockname()[1],
        "unix": str(folder / "listener"),
        "abstract": abstract.getsockname()[1:].decode(),
    }
    for listener in listeners:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()


def serve(listener: socket.socket) -> None:
    while True:
        try:
            connection, _ = listener.accept()
        except OSError:
            return
        with connection:
            connection.sendall(b"hello")


def probing(name: str, parameters: Any, source: str = PROBE) -> dict[str, str | bytes]:
    """The files of a policy that tries an attack of the corpus."""
    attack = (POLICIES / f"{name}.py").read_text()
    return {"policy.py": source, "attack.py": attack, "target.json": json.dumps(parameters)}


def probe(slots: Slots, name: str, parameters: dict[str, Any], **options: Any) -> EpisodeOutcome:
    return slots.play(probing(name, parameters), **{"limits": PATIENT} | options)


def attempts(outcome: EpisodeOutcome) -> dict[str, list[str]]:
    """The probe's output, by `held` and `THROUGH`."""
    found: dict[str, list[str]] = {"held": [], "THROUGH": []}
    for line in outcome.stdout.decode().splitlines():
        verdict, _, rest = line.partition(": ")
        found[verdict].append(rest.partition(" - ")[0])
    return found


def serves_honestly(slots: Slots, tier: str = "bwrap", packages: tuple[str, ...] = ()) -> bool:
    outcome = slots.play(HONEST, tier=tier, packages=packages)
    return outcome.failure is None and outcome.length == 60 and outcome.stdout == b""


def with_packages(attacks: Iterable[Any]) -> list[Any]:
    """Each attack with each of `PACKAGES` that it can be tried with; in the system's layer where it does not use
    them."""
    return [
        pytest.param(
            attack,
            packages,
            id="-".join((attack.name, *packages)),
            marks=[] if set(packages) <= set(attack.packages) else pytest.mark.system,
        )
        for attack in attacks
        for packages in PACKAGES
        if set(attack.packages) <= set(packages)
    ]


@pytest.mark.parametrize(("attack", "packages"), with_packages(PROBES))
def test_nothing_gets_through(
    slots: Slots, target: dict[str, Any], attack: Probe, packages: tuple[str, ...]
) -> None:
    outcome = probe(slots, attack.name, target, packages=packages)
    assert outcome.failure is None, outcome.failure
    assert attempts(outcome)["THROUGH"] == [], outcome.stdout.decode()
    assert len(attempts(outcome)["held"]) > 0
    assert serves_honestly(slots, packages=packages)


OPEN_WITHOUT_NAMESPACES = {
    # There is no network or pid namespace: Landlock and the filter hold what matters, names can be seen.
    *("its parent", "anything but a low pid of its own", "any pid that answers"),
    "interfaces",
}


@pytest.mark.parametrize("attack", PROBES, ids=lambda attack: attack.name)
def test_little_gets_through_in_the_weaker_tier(slots: Slots, target: dict[str, Any], attack: Probe) -> None:
    outcome = probe(slots, attack.name, target, tier="landlock", packages=attack.packages)
    assert outcome.failure is None, outcome.failure
    assert set(attempts(outcome)["THROUGH"]) <= OPEN_WITHOUT_NAMESPACES, outcome.stdout.decode()
    assert serves_honestly(slots, "landlock", attack.packages)


@pytest.mark.parametrize(
    "attack", [attack for attack in PROBES if attack.off], ids=lambda attack: attack.name
)
def test_without_its_defence_each_attack_succeeds(
    slots: Slots, target: dict[str, Any], attack: Probe
) -> None:
    assert attack.off is not None
    before = {*Path("/dev/shm").iterdir()}
    found = attempts(probe(slots, attack.name, target, packages=attack.packages, **attack.off))
    for left in {*Path("/dev/shm").glob("sem.mp-*")} - before:  # of its worker pool
        left.unlink()
    shut = attack.stays_shut if os.geteuid() == 0 else attack.stays_shut | attack.opens_for_root
    assert set(found["held"]) <= shut
    assert found["THROUGH"] or os.geteuid() != 0


@pytest.mark.parametrize(("attack", "packages"), with_packages(BREAKERS))
def test_a_breaker_gets_its_verdict(slots: Slots, attack: Breaker, packages: tuple[str, ...]) -> None:
    outcome = slots.play(attack.source, limits=attack.limits, packages=packages)
    assert category_of(outcome) == attack.verdict, outcome.failure
    assert outcome.length == 60
    assert len(outcome.stdout) <= 65536
    if outcome.failure is not None and attack.off is not None:
        assert outcome.failure.limit is not None
    assert serves_honestly(slots, packages=packages)


WEAKER: dict[str, set[str | None]] = {
    # Its /tmp is the machine's, which it may not write to.
    "disk filling": {"act_error"},
    # What it writes is limited file by file.
    "disk filling by many files": {None},
    # Their number is limited by the time of an act alone, which a slow disk may use up.
    "thousands of files": {None, "act_timeout"},
    # Threads are counted ten times a second, and only while it owes an answer.
    "thread bomb": {None, "process_limit"},
    # It is no process 1, which signals without a handler do not reach.
    "a signal for an illegal instruction": {"killed"},
}
"""Where the weaker tier comes to another verdict."""


@pytest.mark.parametrize("attack", BREAKERS, ids=lambda attack: attack.name)
def test_a_breaker_does_no_harm_in_the_weaker_tier(slots: Slots, attack: Breaker) -> None:
    outcome = slots.play(attack.source, limits=attack.limits, tier="landlock", packages=attack.packages)
    verdict = outcome.failure.category if outcome.failure else None
    assert verdict in WEAKER.get(attack.name, {attack.verdict}), outcome.failure
    assert serves_honestly(slots, "landlock", attack.packages)


@pytest.mark.parametrize(
    "attack", [attack for attack in BREAKERS if attack.off], ids=lambda attack: attack.name
)
def test_with_a_higher_limit_the_same_code_succeeds(slots: Slots, attack: Breaker) -> None:
    assert attack.off is not None
    assert slots.play(attack.source, limits=attack.off, packages=attack.packages).failure is None


@pytest.mark.parametrize(
    "attack",
    [attack for attack in BREAKERS if attack.unsealed and attack.possible],
    ids=lambda attack: attack.name,
)
def test_without_the_seal_the_same_code_succeeds(slots: Slots, attack: Breaker) -> None:
    options = {"limits": attack.limits, "packages": attack.packages}
    failure = slots.play(attack.source, sealed=False, **options).failure
    assert failure is None, failure


@pytest.mark.parametrize(
    "attack", [attack for attack in BREAKERS if attack.in_process], ids=lambda attack: attack.name
)
@pytest.mark.system
def test_in_the_environments_own_process_the_same_code_does_harm(attack: Breaker) -> None:
    assert harmed(attack.source) is not None


def test_an_honest_policy_plays_in_the_environments_own_process_too() -> None:
    assert harmed(BREAKERS[0].source.replace("time.sleep(0.8)", "pass"), timeout_s=60.0) is None


def test_nothing_of_an_episode_is_left_for_the_next(slots: Slots) -> None:
    probe(slots, "leave_traces", {})
    assert attempts(probe(slots, "find_traces", {}))["THROUGH"] == []
    # Undefended, files and shared memory of the first are there for the second.
    probe(slots, "leave_traces", {}, **NO_SANDBOX)
    found = attempts(probe(slots, "find_traces", {}, **NO_SANDBOX))["THROUGH"]
    assert {"in /tmp", "in shared memory", "in System V memory"} <= set(found)


def test_the_cases_seed_is_nowhere_in_the_policys_process(slots: Slots) -> None:
    parameters = {"masked_seed": SEED ^ 0x5A5A5A5A}
    found = attempts(probe(slots, "find_seed", parameters, seed=SEED))
    assert found == {"held": ["in an object", "in random's state", "in numpy's state"], "THROUGH": []}
    # The search does find what is there: the same policy, given the number.
    source = PROBE.replace("import attack", f"import attack\nGIVEN = [{SEED}]")
    found = attempts(slots.play(probing("find_seed", parameters, source), seed=SEED))
    assert found["THROUGH"] == ["in an object"]


def test_train_and_hidden_episodes_look_the_same_to_a_policy(slots: Slots) -> None:
    source = (POLICIES / "see_all.py").read_text()
    train = slots.play(source, record="full").stdout
    hidden = slots.play(source, record="actions").stdout
    assert train == hidden
    assert len(train) > 1000


def printed(slots: Slots, name: str, parameters: Any, **options: Any) -> bytes:
    """The output of a policy of the corpus that is no probe, and that nothing prevents."""
    files: dict[str, str | bytes] = {
        "policy.py": (POLICIES / f"{name}.py").read_text(),
        "target.json": json.dumps(parameters),
    }
    outcome = slots.play(files, limits=PATIENT, **options)
    assert outcome.failure is None, outcome.failure
    return outcome.stdout


@pytest.mark.parametrize("tier", ["bwrap", "none"])
def test_names_that_a_policy_looked_for_tell_a_later_one_nothing(slots: Slots, tier: str) -> None:
    bits, tag = [random.getrandbits(1) for _ in range(400)], f"{random.getrandbits(64):x}"

    def play(slot: Any, **parameters: Any) -> bytes:
        return printed(slots, "names", {"tag": tag, **parameters}, slot=slot, tier=tier)

    play(slots.slot(tier), role="tell", bits=bits)  # type: ignore[arg-type]
    # Undefended one folder is enough: there are many.
    walk = "/" if tier == "bwrap" else os.path.dirname(os.__file__)
    heard, machines_folders = json.loads(
        play(second_slot(slots, tier), role="listen", n=len(bits), walk=walk)
    )
    agreeing = sum(one == bool(other) for one, other in zip(heard, bits, strict=True))
    # Guessing gets 200 of them, give or take ten; a busy machine forgets some of what was told.
    assert (agreeing > 250) == (tier == "none"), agreeing
    assert (machines_folders != []) == (tier == "none"), machines_folders


def unpacked(text: str) -> bytes:
    return zlib.decompress(base64.b64decode(text))


def test_a_policy_finds_nothing_in_memory_of_the_policies_before_it(slots: Slots) -> None:
    def read(slot: Any, pages: list[int]) -> tuple[bytes, dict[str, bytes]]:
        digests, shown = json.loads(printed(slots, "own_memory", pages, slot=slot))
        return unpacked(digests), {page: unpacked(content) for page, content in shown.items()}

    with slots.running() as slot:
        first, _ = read(slot, [])
        differing: set[int] = set()
        for status in (3, 77):
            slots.play(misbehaving(act=f"time.sleep(0.05); os._exit({status})"), slot=slot, limits=PATIENT)
            digests, _ = read(slot, [])
            assert len(digests) == len(first) > 1000, "its memory has another size"
            differing |= {
                k for k, (one, other) in enumerate(zip(first, digests, strict=True)) if one != other
            }
        shown = [read(slot, sorted(differing))[1] for _ in range(3)]
    words = 0
    for page in shown[0]:
        contents = [one[page] for one in shown]
        n = sum(len({content[k : k + 8] for content in contents}) > 1 for k in range(0, len(contents[0]), 8))
        # The clock's page, which the kernel shows to every process, has more words that change.
        words += n if n < 12 else 0
    # The time at which its own files were written, and the core that it runs on.
    assert words <= 3, shown


USEFUL = acting(
    init="""
        with tempfile.NamedTemporaryFile() as file:
            file.write(b"x" * 100); file.flush(); os.fsync(file.fileno())
        np.save("table.npy", np.arange(1000.0))
        table = np.load("table.npy", mmap_mode="r+"); table[3] = 7.0; table.flush()
        shutil.copytree(".", "../tmp/copy")
        assert np.load("../tmp/copy/table.npy")[3] == 7.0
        assert pathlib.Path("../tmp/copy/policy.py").stat().st_size == os.path.getsize("policy.py")
        assert len(mmap.mmap(-1, 4096, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)) == 4096
        answers, event = queue.Queue(), threading.Event()
        threads = [threading.Thread(target=lambda k=k: (event.wait(), answers.put(k))) for k in range(3)]
        [thread.start() for thread in threads]; event.set(); [thread.join() for thread in threads]
        assert sorted(answers.queue) == [0, 1, 2]
        np.linalg.svd(np.random.default_rng().random((300, 300)))
        assert ctypes.CDLL("libm.so.6").floor is not None
        selector = selectors.DefaultSelector(); selector.register(os.eventfd(1), selectors.EVENT_READ)
        assert len(selector.select(1.0)) == 1
        time.sleep(0.001); sys.stdout.flush()
    """,
    before="""
        import ctypes, mmap, os, pathlib, queue, selectors, shutil, sys, tempfile, threading, time
        import numpy as np
    """,
)


@pytest.mark.parametrize("tier", ["bwrap", "landlock"])
def test_what_honest_policies_use_is_there(slots: Slots, tier: str) -> None:
    assert slots.play(USEFUL, tier=tier, limits=PATIENT).failure is None


def test_no_pickle_is_ever_opened(slots: Slots, tmp_path: Path) -> None:
    (attack,) = [attack for attack in BREAKERS if attack.name == "a pickle"]
    for tier in ("bwrap", "none"):
        outcome = slots.play(attack.source, tier=tier)
        assert rows(outcome)[3].action == "<P>"
        assert not Path("/tmp/evopolicy-pickled").exists()


@pytest.mark.parametrize("way", ["files", "shm", "abstract", "lock", "record", "futex", "device", "signals"])
def test_policies_in_parallel_slots_cannot_talk(slots: Slots, way: str) -> None:
    heard = {}
    for tier in ("bwrap", "none"):
        pair = [slots.slot(tier), second_slot(slots, tier)]
        plays = []
        for slot, role in zip(pair, ("tell", "listen"), strict=True):
            folder = slots.bundle(probing("talk", {"role": role, "way": way}))
            plays.append(
                slot.play_job(make_job(tier=tier, limits=PATIENT), folder, lambda episodes, steps: None)
            )
        (_,), (listener,) = slots.run(both(*plays))
        heard[tier] = attempts(listener)["THROUGH"] != []
    assert heard == {"bwrap": False, "none": True}


def second_slot(slots: Slots, tier: str) -> Any:
    found = vars(slots).setdefault("second", {})
    if tier not in found:
        found[tier] = slots.new(tier)  # type: ignore[arg-type]
        slots.run(found[tier].start())
        slots._slots[f"second {tier}", True, ()] = found[tier]
    return found[tier]


async def both(*plays: Any) -> Any:
    return await asyncio.gather(*plays)


def test_the_documented_table_is_the_corpus() -> None:
    path = Path(__file__).parents[3] / "docs" / "explanation" / "hostile-policies.md"
    assert path.read_text(encoding="utf-8") == document(), "make it anew: see corpus.py"


def test_a_bundle_of_thousands_of_files_is_played(slots: Slots) -> None:
    files: dict[str, str | bytes] = {f"data/{k % 40}/{k}.bin": bytes([k % 256]) for k in range(1999)}
    files["policy.py"] = HONEST + "\nimport os\nprint(sum(len(files) for _, _, files in os.walk('.')))"
    outcome = slots.play(files)
    assert (outcome.failure, outcome.stdout) == (None, b"2000\n")


@pytest.mark.parametrize(
    "decoy", ["policy/__init__.py", f"policy{EXTENSION_SUFFIXES[0]}", f"policy{EXTENSION_SUFFIXES[-1]}"]
)
def test_policy_py_is_played_whatever_else_has_its_name(slots: Slots, decoy: str) -> None:
    files: dict[str, str | bytes] = {
        "policy.py": f"MINE = 1\nimport helper\n{HONEST}",
        "helper.py": "import policy\nprint(policy.__file__[-9:], policy.MINE)",
        decoy: "print('a decoy is played')",
    }
    outcome = slots.play(files)
    assert (outcome.failure, outcome.stdout) == (None, b"policy.py 1\n")
    # Python itself prefers the decoy.
    folder = str(slots.bundle(files))
    usual = [(ExtensionFileLoader, EXTENSION_SUFFIXES), (SourceFileLoader, SOURCE_SUFFIXES)]
    spec = FileFinder(folder, *usual).find_spec("policy")
    assert spec is not None
    assert spec.origin == f"{folder}/{decoy}"


def test_a_link_in_an_unpacked_bundle_is_never_followed(slots: Slots, target: dict[str, Any]) -> None:
    folder = slots.bundle(HONEST)
    (folder / "data.txt").symlink_to(target["secret_file"])
    with pytest.raises(WorkerError, match="cannot be read"):
        slots.run(slots.slot().play_job(make_job(), folder, lambda episodes, steps: None))
    assert serves_honestly(slots)
