"""Options of the test run."""

from __future__ import annotations

import asyncio
import gc
import inspect
import os
import re
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import pytest
from parallel import Parallel

if TYPE_CHECKING:
    from forked import Forks
    from machines.postgres import Server
    from machines.seaweedfs import ObjectStore
    from slots import Slots

_LEFT_OUT: dict[str, Callable[[bytes], object]] = {
    "not system and not families and not cluster": (
        re.compile(rb"^pytestmark = \[?\s*pytest\.mark\.(system|families|cluster)\b", re.MULTILINE).search
    ),
    "cluster": lambda text: b"pytest.mark.cluster" not in text,
    "system or families": lambda text: (
        b"pytest.mark.system" not in text and b"pytest.mark.families" not in text
    ),
    "system": lambda text: b"pytest.mark.system" not in text,
    "families": lambda text: b"pytest.mark.families" not in text,
}
"""By `-m`: whether a file has no test of the layer. A file of another layer than `make test` says so in its first
mark."""

_WALLS = (
    *(f"tests/conformance/{name}/" for name in ("cheats", "hostile")),
    *(f"tests/unit/gateway/{name}/" for name in ("jail", "agent_supervisor")),
    *(
        f"tests/unit/{name}"
        for name in ("worker/runtime/", "worker/slot_endings/", "common/processes/test_cgroups.py")
    ),
    *(f"tests/integration/{name}" for name in ("worker/", "gateway/agents/test_jailed_agents.py")),
)
"""Tests of sandbox and jail, which root gets in another way than an ordinary user: marked `walls`."""

_ONE_BY_ONE = (
    *(f"tests/families/test_{name}.py::" for name in ("proof_of_life", "parity", "cited_policies")),
    "tests/unit/worker/runtime/test_foreign_slots.py::",
    "tests/integration/coordinator/test_standby.py::",
)
"""Their tests share nothing and take minutes together: each is played where there is room."""
_SHARED = ("cheated", "forked")
"""Fixtures that files share: a cluster to be cheated, and a process with all commands imported."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """Plays files beside each other where `--processes` asks for it."""
    processes = session.config.getoption("processes")
    if not processes or session.testsfailed or session.config.option.collectonly:
        return None
    Parallel(session, _group).play(processes)
    return True


def _group(item: pytest.Item) -> object:
    """Tests of one group are played by one process: those of a file, or of a fixture that takes seconds to set up."""
    if item.nodeid.startswith(_ONE_BY_ONE):
        return item
    fixtures = getattr(item, "fixturenames", ())
    return next((name for name in _SHARED if name in fixtures), item.path)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--processes", type=int, default=0, help="play files in this many processes; 0: in this one"
    )
    parser.addoption(
        "--fault-seeds",
        type=int,
        default=0,
        help="tests/faults: instants at which each kind of fault strikes; 0: some kinds only, at one",
    )
    parser.addoption(
        "--rewrite-transcripts",
        action="store_true",
        help=(
            "write the core's transcripts (coordinator/evopolicy_coordinator/core/transcripts) anew from what it"
            " does now"
        ),
    )


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Files that a layer leaves out are not imported: each of its processes would."""
    left_out = _LEFT_OUT.get(config.getoption("markexpr"))
    is_test = left_out and collection_path.name.startswith("test_") and collection_path.suffix == ".py"
    return True if is_test and left_out(collection_path.read_bytes()) else None


@pytest.hookimpl(tryfirst=True)  # before -m selects by marker
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Marks tests of walls, skips what needs root, and puts files with slow tests first, unit tests last, others in
    the order of their paths.

    Processes take files in this order, so that they end at about the same time. There unit tests, which compute, stand
    among the others, which wait for processes and clusters.
    """
    for item in items:
        if item.nodeid.startswith(_WALLS):
            item.add_marker("walls")
        if os.geteuid() != 0 and item.get_closest_marker("root") is not None:
            layer = "test-long" if item.get_closest_marker("system") is not None else "test-root"
            item.add_marker(pytest.mark.skip(f"needs root: make {layer} as root"))
    files = list(dict.fromkeys(item.path for item in items))
    # Where time may end before the tests do, others are the last ones each time.
    first = int(float(os.environ.get("EVOPOLICY_TESTS_UNTIL", 0))) % max(len(files), 1)
    files = files[first:] + files[:first]
    slow = {item.path for item in items if item.get_closest_marker("slow") is not None}
    unit = {path for path in files if path.is_relative_to(Path(__file__).parent / "unit")}
    # Where the files of a kind begin and end.
    spans = (
        ((0.0, 0.0), (1.0, 1.7), (1.0, 2.0)) if config.getoption("processes") else ((0, 0), (1, 1), (2, 2))
    )
    place: dict[Path, float] = {}
    for (begin, end), kind in zip(spans, (slow, {*files} - slow - unit, unit - slow), strict=True):
        ordered = [path for path in files if path in kind]
        place |= {path: begin + (end - begin) * k / len(ordered) for k, path in enumerate(ordered)}
    items.sort(key=lambda item: place[item.path])


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Plays a test that is a coroutine function in an event loop of its own."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    asyncio.run(
        pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames})
    )
    return True


def pytest_collection_finish() -> None:
    """What is imported and collected stays: each collection of garbage would look through all of it again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def forked() -> Iterator[Forks]:
    """Plays commands without the start of Python."""
    from forked import Forks

    forks = Forks()
    yield forks
    forks.close()


@pytest.fixture
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands that would compute in a process for each core do so in this one, which has imported everything."""
    monkeypatch.setattr(os, "cpu_count", lambda: 1)


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    """A PostgreSQL server; commands find its password."""
    from machines.postgres import Server

    found = Server()
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("PGPASSFILE", str(found.passfile))
        yield found
    found.close()


@pytest.fixture(scope="session")
def object_store() -> Iterator[ObjectStore]:
    """An S3 service; commands find its keys."""
    from machines.seaweedfs import ObjectStore

    found = ObjectStore()
    with pytest.MonkeyPatch.context() as patched:
        for name, value in found.keys.items():
            patched.setenv(name, value)
        yield found
    found.close()


@pytest.fixture(scope="session")
def slots(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Slots]:
    """Shared by all tests of a process: each slot has to be healthy after what another test or attack did to it."""
    from slots import Slots

    found = Slots(tmp_path_factory.mktemp("slots"))
    yield found
    found.close()


@pytest.fixture(scope="session", autouse=True)
def _state_of_its_own() -> Iterator[None]:
    """Local commands share one state per user: not the developer's, and another for each process of tests."""
    with tempfile.TemporaryDirectory(prefix="evp-state-", ignore_cleanup_errors=True) as folder:
        os.environ["XDG_STATE_HOME"] = folder
        yield


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """No test begins after EVOPOLICY_TESTS_UNTIL (Unix time), by which `.ci/run` ends in its time; those that have
    failed are tried once more even so."""
    late = time.time() > float(os.environ.get("EVOPOLICY_TESTS_UNTIL", "inf"))
    if late and not item.config.getoption("lf"):
        pytest.skip("not begun before the time in EVOPOLICY_TESTS_UNTIL: make test-long")


def pytest_unconfigure(config: pytest.Config) -> None:
    """The last line: how many tests were left out, and why."""
    reporter = config.pluginmanager.getplugin("terminalreporter")
    if reporter is None or not (skipped := reporter.stats.get("skipped", [])):
        return
    reasons = Counter(str(report.longrepr[2]).removeprefix("Skipped: ") for report in skipped)
    reporter.write_line(
        f"left out: {len(skipped)} ({'; '.join(f'{n}: {reason}' for reason, n in reasons.most_common())})"
    )


def pytest_configure(config: pytest.Config) -> None:
    # A shell ignores Ctrl-C for what it starts in the background, and children inherit that: tests that press it could
    # not be run there.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # How long an example takes says how busy the machine is.
    hypothesis.settings.register_profile("patient", deadline=None)
    hypothesis.settings.load_profile("patient")
