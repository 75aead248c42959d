"""Applies a function to many items in several child processes, connected by pipes.

The pipes have no names, so nothing is left behind when the parent is killed, and the children end with it. If a child
ends while it processes an item, only that item is lost.
"""

from __future__ import annotations

import contextlib
import pickle
import queue
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from evopolicy_common.processes.parent_death import ending_with_parent

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_processes(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    jobs: int,
    when_lost: Callable[[Item, str], Result],
    *,
    at_once: int = 8,
) -> Iterator[Result]:
    """Yields `function` of each item, in order; for an item whose process ended, `when_lost` of the item and the
    reason. A process receives `at_once` items at a time.

    The children import `function` by its name; items and results are pickled. Call it on the main thread.
    """
    children = [_Child(function) for _ in range(jobs)]
    idle: queue.SimpleQueue[_Child] = queue.SimpleQueue()
    for each in children:
        idle.put(each)

    def work(some: Sequence[Item]) -> list[Result]:
        child = idle.get()
        try:
            return child.results(some, when_lost)
        finally:
            idle.put(child)

    pool = ThreadPoolExecutor(jobs)
    try:
        for results in pool.map(work, [items[i : i + at_once] for i in range(0, len(items), at_once)]):
            yield from results
    finally:
        for each in children:
            each.end()  # unfinished items are not needed
        pool.shutdown(cancel_futures=True)
        for each in children:
            each.end()  # children that were just being restarted


class _Child:
    """A child process for items. Several threads may use it, one at a time."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self._function = function
        self._over = False
        self._process = self._started()

    def results(self, items: Sequence[Item], when_lost: Callable[[Item, str], Result]) -> list[Result]:
        try:
            self._tell(items)
            found: list[Result] = pickle.load(self._output)
            return found
        except (OSError, EOFError, pickle.UnpicklingError):
            if self._over:
                raise
            self._kill()
            why = f"the process that read it ended with status {self._process.returncode}"
            self._process = self._started()
        if len(items) == 1:
            return [when_lost(items[0], why)]
        # Items sent one by one show which of them ends the process.
        return [result for item in items for result in self.results([item], when_lost)]

    def end(self) -> None:
        """Kills the process for good; does nothing if it has ended."""
        self._over = True
        self._kill()

    def _kill(self) -> None:
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()

    def _started(self) -> subprocess.Popen[bytes]:
        # Not `-m`: this module may be imported with its package before, and runpy would warn of that on the terminal.
        main = f"from {__name__} import main; main()"
        # A session of its own, so that Ctrl-C reaches only the command.
        return subprocess.Popen(
            ending_with_parent([sys.executable, "-P", "-c", main], signal.SIGKILL),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )

    def _tell(self, items: Sequence[Any]) -> None:
        assert self._process.stdin is not None
        pickle.dump((self._function, items), self._process.stdin)
        self._process.stdin.flush()

    @property
    def _output(self) -> Any:
        return self._process.stdout


def main() -> None:
    """Main loop of a child: processes items from stdin until it is closed."""
    results = sys.stdout.buffer
    sys.stdout = sys.stderr
    while True:
        try:
            function, items = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        pickle.dump([function(item) for item in items], results)
        results.flush()
