"""Signals of policies that copy recorded train actions: a run of numbers in a checkpoint that an earlier trajectory
has.

A window of consecutive actions is compared as a whole, and only if it varies. Numbers that an earlier checkpoint
already held are not copied from a trajectory: an open-loop policy's own plan comes back in its feedback.
"""

from __future__ import annotations

import ast
import itertools
import json
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evopolicy_common.records.episodes.npz import read_arrays
from evopolicy_results.code.sources import parsed
from evopolicy_results.scan.signals import Files, Signal, Trajectories, signal

_WINDOW = 24
"""Consecutive numbers that must agree."""
_FEWEST_VALUES, _FEWEST_CHANGES = 3, 8
"""Different numbers, and changes between neighbours, that a window must have: constant and periodic plans have few."""
_MAX_FILE, _MAX_UNPACKED = 4 << 20, 64 << 20
_MAX_NUMBERS = 400_000
"""Of a run's checkpoints, and of its trajectories."""

Window = tuple[float, ...]


def copied_actions(checkpoints: Sequence[tuple[int, Files]], trajectories: Trajectories) -> Iterator[Signal]:
    """A signal for each file of a checkpoint that newly holds actions of an earlier submit's train episodes.
    Trajectories are read only if a later checkpoint has new long runs of numbers."""
    new = list(_fresh(checkpoints))
    last = max((place for place, (_, fresh) in enumerate(new) if fresh), default=0)
    recorded: dict[Window, int] = {}
    reported: set[str] = set()
    for place, (index, fresh) in enumerate(new[: last + 1]):
        for path, windows in fresh.items():
            copied = next((window for window in windows if window in recorded), None)
            if copied is not None and path not in reported:
                reported.add(path)
                quote = ", ".join(f"{value:g}" for value in copied)
                reason = (
                    f"{_WINDOW} consecutive numbers or more are recorded actions of submit {recorded[copied]}"
                )
                yield signal("copy", f"system/{path}", 0, reason, quote, (index,))
        if place < last:
            for actions in trajectories(index):
                for window in _windows(_flat(actions)):
                    recorded.setdefault(window, index)
                if len(recorded) > _MAX_NUMBERS:
                    return


def _fresh(checkpoints: Sequence[tuple[int, Files]]) -> Iterator[tuple[int, dict[str, list[Window]]]]:
    """The windows of each checkpoint's files that no earlier one held, until `_MAX_NUMBERS` numbers were read."""
    remaining = _MAX_NUMBERS
    own: set[Window] = set()
    known: set[tuple[str, bytes]] = set()
    for index, files in checkpoints:
        fresh: dict[str, list[Window]] = {}
        # Most files of a run's checkpoints are equal.
        for path, data in [each for each in files.items() if each not in known]:
            known.add((path, data))
            for numbers in _sequences(path, data):
                remaining -= len(numbers)
                if remaining < 0:
                    return
                if new := [each for each in _windows(numbers) if each not in own]:
                    fresh.setdefault(path, []).extend(new)
        own.update(*fresh.values())
        yield index, fresh


def _windows(numbers: Sequence[float]) -> Iterator[Window]:
    """The windows that vary, and neither repeat with a short period nor have one step, as common tables do."""
    n = len(numbers) - _WINDOW + 1
    if n < 1:
        return
    values = np.array(numbers)
    varied = _in_each(values[1:] != values[:-1], n) >= _FEWEST_CHANGES
    for period in range(1, 9):
        varied &= _in_each(values[period:] == values[:-period], n) < _WINDOW - period
    steps = np.array([round(other - one, 9) for one, other in itertools.pairwise(numbers)])
    varied &= _in_each(steps[1:] == steps[:-1], n) < _WINDOW - 2
    for start in np.flatnonzero(varied).tolist():
        window = tuple(numbers[start : start + _WINDOW])
        if len(set(window)) >= _FEWEST_VALUES:
            yield window


def _in_each(flags: NDArray[np.bool_], n: int) -> NDArray[np.int64]:
    """How many flags are true in each of `n` windows that begin one flag apart and cover all flags."""
    sums: NDArray[np.int64] = np.concatenate([[0], np.cumsum(flags)])
    return sums[-n:] - sums[:n]


def _flat(actions: Sequence[Any]) -> list[float]:
    numbers: list[float] = []
    for action in actions:
        try:
            numbers += [_rounded(value) for value in np.asarray(action, dtype=np.float64).reshape(-1)]
        except (TypeError, ValueError, OverflowError):
            return []
        if len(numbers) > _MAX_NUMBERS:
            break
    return numbers


def _rounded(value: float) -> float:
    """float32 actions come back as other decimals than the policy's literal had."""
    try:
        return float(f"{value:.5g}")
    except OverflowError:  # an integer that no float can hold
        return math.inf if value > 0 else -math.inf


def _sequences(path: str, data: bytes) -> Iterator[list[float]]:
    """Runs of numbers in a file: literals of Python, arrays of JSON and numpy, columns of text."""
    if len(data) > _MAX_FILE:
        return
    if path.endswith(".py"):
        for node in parsed(data):
            if isinstance(node, ast.List | ast.Tuple) and len(node.elts) * 8 >= _WINDOW:
                yield from (numbers for numbers in _arrays(_literal(node)) if len(numbers) >= _WINDOW)
    elif path.endswith(".json"):
        try:
            yield from _arrays(json.loads(data))
        except (ValueError, RecursionError):
            return
    elif path.endswith((".npy", ".npz")):
        try:
            arrays = read_arrays(data, _MAX_UNPACKED)
        except ValueError:
            return
        for array in arrays.values():
            if array.dtype.kind in "fiu" and array.size <= _MAX_NUMBERS:
                yield [_rounded(value) for value in array.astype(np.float64).reshape(-1)]
    elif path.endswith((".csv", ".txt")):
        numbers = []
        for word in data.decode("utf-8", "replace").replace(",", " ").split():
            try:
                numbers.append(_rounded(float(word)))
            except ValueError:
                continue
        if _WINDOW <= len(numbers) <= _MAX_NUMBERS:
            yield numbers


def _literal(node: ast.expr) -> Any:
    """A literal's lists of numbers, with None in place of everything else."""
    if isinstance(node, ast.List | ast.Tuple):
        return [_literal(each) for each in node.elts]
    is_negative = isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub)
    number = node.operand if isinstance(node, ast.UnaryOp) and is_negative else node
    value = number.value if isinstance(number, ast.Constant) else None
    return (-1 if is_negative else 1) * value if isinstance(value, int | float) else None


def _arrays(value: Any) -> Iterator[list[float]]:
    """The numbers of each outermost list of a JSON value, in order."""
    queue = [value]
    while queue:
        one = queue.pop()
        if isinstance(one, dict):
            queue += one.values()
        elif isinstance(one, list):
            numbers: list[float] = []
            inner: list[Any] = list(reversed(one))
            while inner and len(numbers) <= _MAX_NUMBERS:
                each = inner.pop()
                if isinstance(each, list):
                    inner += reversed(each)
                elif isinstance(each, dict):
                    queue.append(each)
                elif isinstance(each, int | float) and not isinstance(each, bool):
                    numbers.append(_rounded(each))
            yield numbers
