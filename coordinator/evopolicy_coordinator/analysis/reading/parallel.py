"""A function over many items, in several processes: plain children with pipes.

Nothing that they use has a name, so nothing is left when whoever started them is killed; they end with it. An item over which
a process ends costs that item alone.
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

_AT_ONCE = 8
"""Items that a process is given at a time."""


def in_processes(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    jobs: int,
    when_lost: Callable[[Item, str], Result],
) -> Iterator[Result]:
    """`function` of each item, in order; where its process ended over an item, `when_lost` of it and why.

    The children find `function` by its name; items and results are pickled. Call it on the main thread.
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
        for results in pool.map(work, [items[i : i + _AT_ONCE] for i in range(0, len(items), _AT_ONCE)]):
            yield from results
    finally:
        for each in children:
            each.end()  # nobody wants what is not done yet
        pool.shutdown(cancel_futures=True)
        for each in children:
            each.end()  # who was just being started again


class _Child:
    """A process that is given items. Threads may use it one after another."""

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
        # Which of them it ended over shows one by one.
        return [result for item in items for result in self.results([item], when_lost)]

    def end(self) -> None:
        """Kills it for good. Nothing when it has ended."""
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
        # A session of its own, so that Ctrl-C reaches the command alone.
        return subprocess.Popen(
            ending_with_parent([sys.executable, "-P", "-m", __name__], signal.SIGKILL),
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
    """A child: works on what comes on stdin until that ends."""
    results = sys.stdout.buffer
    sys.stdout = sys.stderr
    while True:
        try:
            function, items = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        pickle.dump([function(item) for item in items], results)
        results.flush()


if __name__ == "__main__":
    main()
