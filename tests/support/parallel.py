"""Plays tests in processes that are forked from one that has imported and collected them all.

Each file of tests is played by one process, which sets up the fixtures of its modules once. Files are begun in the
order of the collected tests; those with the mark `alone`, which look at the whole machine, when all others have ended.
"""

from __future__ import annotations

import atexit
import contextlib
import io
import os
import sys
import traceback
import types
import warnings
from collections import deque
from collections.abc import Callable
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

import pytest
from _pytest._io import TerminalWriter


class _Process(NamedTuple):
    name: str
    pid: int
    tests: deque[int]
    """Places of the test that it plays, and of those after it."""


class Parallel:
    """The process from which the others are forked: gives them tests, and reports what they say."""

    def __init__(self, session: pytest.Session, group: Callable[[pytest.Item], object]) -> None:
        """`group`: tests with the same value are played by one process, in order."""
        self._session = session
        groups: dict[object, deque[int]] = {}
        for place, item in enumerate(session.items):
            groups.setdefault(group(item), deque()).append(place)
        self._waiting = deque[deque[int]]()
        self._alone = deque[deque[int]]()
        for tests in groups.values():
            is_alone = session.items[tests[0]].get_closest_marker("alone")
            (self._alone if is_alone else self._waiting).append(tests)
        self._playing: dict[Connection, _Process] = {}
        self._started = 0

    def play(self, processes: int) -> None:
        """Plays all tests in at most that many processes."""
        self._session.config.pluginmanager.getplugin("terminalreporter").showfspath = False
        try:
            for tests, most in ((self._waiting, processes), (self._alone, 1)):
                self._waiting = tests
                for _ in range(min(most, len(self._waiting))):
                    self._start()
                while self._playing:
                    for ready in wait([*self._playing]):
                        assert isinstance(ready, Connection)
                        self._receive(ready)
        finally:
            # At the end of its connection a process ends its test and its fixtures; Ctrl-C in a terminal goes to all.
            for connection, process in self._playing.items():
                connection.close()
                os.waitpid(process.pid, 0)
        if self._session.shouldfail:
            raise self._session.Failed(self._session.shouldfail)
        if self._session.shouldstop:
            raise self._session.Interrupted(self._session.shouldstop)

    def _start(self) -> None:
        name = f"p{self._started}"
        self._started += 1
        here, there = Pipe()
        sys.stdout.flush()
        sys.stderr.flush()
        if pid := os.fork():
            there.close()
            self._playing[here] = _Process(name, pid, deque())
            self._give(here)
            return
        status = 1
        try:
            for each in (here, *self._playing):
                each.close()
            atexit._clear()
            _serve(self._session, name, there)
            atexit._run_exitfuncs()
            status = 0
        except BrokenPipeError:
            pass  # the first process was interrupted, which tells why
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(status)

    def _give(self, to: Connection) -> None:
        """The next test, and the one after it, for which fixtures stay."""
        tests = self._playing[to].tests
        if self._session.shouldfail or self._session.shouldstop:
            tests.clear()
        elif len(tests) < 2 and self._waiting:
            tests.extend(self._waiting.popleft())
        with contextlib.suppress(BrokenPipeError):  # it has died, which is read next
            to.send([*tests, None][:2] if tests else None)

    def _receive(self, connection: Connection) -> None:
        hook = self._session.config.hook
        try:
            kind, content = connection.recv()
        except (EOFError, ConnectionResetError):
            self._note_end(connection)
            return
        if kind == "played":
            self._playing[connection].tests.popleft()
            self._give(connection)
        elif kind == "report":
            report = hook.pytest_report_from_serializable(config=self._session.config, data=content)
            self._log(report, self._playing[connection].name)
        else:
            message = warnings.WarningMessage(*content.pop("warning"))
            hook.pytest_warning_recorded.call_historic(kwargs=content | {"warning_message": message})

    def _log(self, report: pytest.TestReport, name: str) -> None:
        # By this attribute pytest knows that reports of several files are mixed.
        report.node = types.SimpleNamespace(gateway=types.SimpleNamespace(id=name))  # type: ignore[attr-defined]
        self._session.config.hook.pytest_runtest_logreport(report=report)
        del report.node  # type: ignore[attr-defined]

    def _note_end(self, connection: Connection) -> None:
        name, pid, tests = self._playing.pop(connection)
        connection.close()
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        if not tests:
            return
        item = self._session.items[tests.popleft()]
        text = f"the process that played this test ended with status {status}"
        self._log(pytest.TestReport(item.nodeid, item.location, {}, "failed", text, "call"), name)
        if tests:
            self._waiting.appendleft(tests)
        self._start()


class _Sends:
    """What a forked process reports."""

    connection: Connection | None = None
    """None while it is registered, when the warnings from before the fork are told again."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        data = self._config.hook.pytest_report_to_serializable(config=self._config, report=report)
        assert self.connection is not None
        self.connection.send(("report", data))

    def pytest_warning_recorded(
        self, warning_message: warnings.WarningMessage, when: str, nodeid: str, location: Any
    ) -> None:
        if self.connection is not None:
            told = warning_message
            warning = (str(told.message), told.category, told.filename, told.lineno)
            content = {"warning": warning, "when": when, "nodeid": nodeid, "location": location}
            self.connection.send(("warning", content))


class _Nowhere:
    """Takes the terminal reporter's place in a forked process, which reports by its connection."""

    def __init__(self) -> None:
        self._tw = TerminalWriter(io.StringIO())


def _serve(session: pytest.Session, name: str, connection: Connection) -> None:
    """Plays the tests that it is given, to the end of the connection."""
    config = session.config
    capture = config.pluginmanager.getplugin("capturemanager")
    capture.stop_global_capturing()  # its files are the same as in all other processes
    capture.start_global_capturing()
    capture.suspend_global_capture()
    for plugin in ("terminalreporter", "terminalprogress"):
        if config.pluginmanager.hasplugin(plugin):
            config.pluginmanager.unregister(name=plugin)
    # pytest-timeout writes its stacks by this plugin.
    config.pluginmanager.register(_Nowhere(), "terminalreporter")
    sends = _Sends(config)
    config.pluginmanager.register(sends)
    sends.connection = connection
    if config.option.basetemp:
        config.option.basetemp = f"{config.option.basetemp}-{name}"
        config._tmp_path_factory = pytest.TempPathFactory.from_config(config, _ispytest=True)  # type: ignore[attr-defined]
    try:
        with contextlib.suppress(EOFError):
            while order := connection.recv():
                item, following = (None if place is None else session.items[place] for place in order)
                config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                connection.send(("played", None))
    finally:
        session._setupstate.teardown_exact(None)
