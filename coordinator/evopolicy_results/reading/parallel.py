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
from importlib import import_module
from typing import TypeVar

from evopolicy_common.processes.parent_death import ending_with_parent

Item = TypeVar("Item")
Result = TypeVar("Result")


class Processes:
    """Child processes of a command, for all its stages. With one job there are none: this process does the work."""

    def __init__(self, jobs: int = 1, *modules: str) -> None:
        """Starts the children. They import `modules` at once, while this process does something else."""
        self._children = [_Child(modules) for _ in range(jobs if jobs > 1 else 0)]
        # A child ends with the thread that started it, and a thread may have to start one anew.
        self._threads = ThreadPoolExecutor(max(1, len(self._children)))

    def map(
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        when_lost: Callable[[Item, str], Result],
        *,
        at_once: int = 8,
    ) -> Iterator[Result]:
        """Yields `function` of each item, in order; for an item whose process ended, `when_lost` of the item and the
        reason. A child receives `at_once` items at a time. If the iteration is closed early, the children are ended.

        The children import `function` by its name; items and results are pickled. Call it on the main thread.
        """
        if not self._children:
            yield from map(function, items)
            return
        idle: queue.SimpleQueue[_Child] = queue.SimpleQueue()
        for each in self._children:
            idle.put(each)

        def work(some: Sequence[Item]) -> list[Result]:
            child = idle.get()
            try:
                return child.results(function, some, when_lost)
            finally:
                idle.put(child)

        try:
            for results in self._threads.map(
                work, [items[i : i + at_once] for i in range(0, len(items), at_once)]
            ):
                yield from results
        except BaseException:
            self.end()  # unfinished items are not needed
            raise

    def end(self) -> None:
        """Kills the children."""
        for each in self._children:
            each.end()
        self._threads.shutdown(cancel_futures=True)
        for each in self._children:
            each.end()  # children that were just being restarted

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *error: object) -> None:
        self.end()


ALONE = Processes()
"""This process without children."""


class _Child:
    """A child process for items. Several threads may use it, one at a time."""

    def __init__(self, modules: Sequence[str]) -> None:
        self._modules = modules
        self._over = False
        self._process = self._started()

    def results(
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        when_lost: Callable[[Item, str], Result],
    ) -> list[Result]:
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        try:
            pickle.dump((function, items), stdin)
            stdin.flush()
            results: list[Result] = pickle.load(stdout)
            return results
        except (OSError, EOFError, pickle.UnpicklingError):
            if self._over:
                raise
            self._kill()
            why = f"the process that read it ended with status {self._process.returncode}"
            self._process = self._started()
        if len(items) == 1:
            return [when_lost(items[0], why)]
        # Items sent one by one show which of them ends the process.
        return [result for item in items for result in self.results(function, [item], when_lost)]

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
        main = f"from {__name__} import main; main({self._modules!r})"
        # A session of its own, so that Ctrl-C reaches only the command.
        return subprocess.Popen(
            ending_with_parent([sys.executable, "-P", "-c", main], signal.SIGKILL),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )


def main(modules: Sequence[str]) -> None:
    """Main loop of a child: processes items from stdin until it is closed."""
    results = sys.stdout.buffer
    sys.stdout = sys.stderr
    for module in modules:
        import_module(module)
    while True:
        try:
            function, items = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        pickle.dump([function(item) for item in items], results)
        results.flush()
