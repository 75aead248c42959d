"""Applies a function to many items in several child processes, connected by pipes.

The pipes have no names, so none remains when the parent is killed, and the children end with it. If a child
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
        # Not `-m`: this module may be imported with its package before, and runpy would warn of that on the terminal.
        self._main = f"from {__name__} import main; main({modules!r})"
        self._ended = False
        self._children = {self._started() for _ in range(jobs if jobs > 1 else 0)}
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
        reason. A child receives `at_once` items at a time; function, items and results are pickled. If the iteration
        is closed early, the children are ended. Call it on the main thread."""
        if not self._children:
            yield from map(function, items)
            return
        idle: queue.SimpleQueue[subprocess.Popen[bytes]] = queue.SimpleQueue()
        for each in self._children:
            idle.put(each)

        def results(some: Sequence[Item]) -> list[Result]:
            child = idle.get()
            assert child.stdin is not None
            assert child.stdout is not None
            try:
                pickle.dump((function, some), child.stdin)
                child.stdin.flush()
                made: list[Result] = pickle.load(child.stdout)
                return made
            except (OSError, EOFError, pickle.UnpicklingError):
                if self._ended:
                    raise
                _kill(child)
                why = f"the process that read it ended with status {child.returncode}"
                self._children.remove(child)
                child = self._started()
                self._children.add(child)
            finally:
                idle.put(child)
            if len(some) == 1:
                return [when_lost(some[0], why)]
            # Items sent one by one show which of them ends the process.
            return [result for item in some for result in results([item])]

        try:
            batches = [items[i : i + at_once] for i in range(0, len(items), at_once)]
            for made in self._threads.map(results, batches):
                yield from made
        except BaseException:
            self.end()  # unfinished items are not needed
            raise

    def end(self) -> None:
        """Kills the children."""
        self._ended = True
        for _ in range(2):  # the second time those that were just being restarted
            for each in list(self._children):
                _kill(each)
            self._threads.shutdown(cancel_futures=True)

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *error: object) -> None:
        self.end()

    def _started(self) -> subprocess.Popen[bytes]:
        # A session of its own, so that Ctrl-C reaches only the command.
        return subprocess.Popen(
            ending_with_parent([sys.executable, "-P", "-c", self._main], signal.SIGKILL),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )


ALONE = Processes()
"""This process without children."""


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kills the process for good; does nothing if it has ended."""
    process.kill()
    process.wait()
    for pipe in filter(None, (process.stdin, process.stdout)):
        with contextlib.suppress(OSError):
            pipe.close()


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
