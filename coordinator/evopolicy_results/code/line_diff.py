"""Line differences of sources, with a bound on the work: a policy's author may choose lines that are all alike.

If a comparison would exceed `MAX_STEPS`, the sources count as entirely different: lines are counted as a multiset,
and shown as all removed and all added. Nothing here depends on time, so the same sources give the same numbers
everywhere.
"""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Sequence
from typing import Any

MAX_STEPS = 3_000_000
"""Maximum number of compared pairs of equal lines: about a second."""
_CONTEXT = 3


class _TooAlikeError(Exception):
    """The lines repeat so often that comparing them would take too long."""


class _Matcher(difflib.SequenceMatcher[Any]):
    def __init__(self, old: Sequence[Any], new: Sequence[Any]) -> None:
        self._steps = MAX_STEPS
        self._old = old
        super().__init__(None, old, new, autojunk=False)

    def find_longest_match(
        self, alo: int = 0, ahi: int | None = None, blo: int = 0, bhi: int | None = None
    ) -> difflib.Match:
        places: dict[Any, list[int]] = self.b2j  # type: ignore[attr-defined]
        end = len(self._old) if ahi is None else ahi
        self._steps -= sum(1 + len(places.get(self._old[i], ())) for i in range(alo, end))
        if self._steps < 0:
            raise _TooAlikeError
        return super().find_longest_match(alo, ahi, blo, bhi)


def n_changed(old: Sequence[Any], new: Sequence[Any]) -> int:
    """Number of lines removed plus lines added."""
    for _ in range(2):  # without equal lines at the beginning, then at the end
        unequal = (i for i, (a, b) in enumerate(zip(old, new, strict=False)) if a != b)
        head = next(unequal, min(len(old), len(new)))
        old, new = old[head:][::-1], new[head:][::-1]
    try:
        kept = sum(block.size for block in _Matcher(old, new).get_matching_blocks())
    except _TooAlikeError:
        kept = (Counter(old) & Counter(new)).total()
    return len(old) + len(new) - 2 * kept


def unified(old: Sequence[str], new: Sequence[str]) -> list[str]:
    """A unified diff with three lines of context, without the two lines that name the files."""
    try:
        groups = list(_Matcher(old, new).get_grouped_opcodes(_CONTEXT))
    except _TooAlikeError:
        groups = [[("replace", 0, len(old), 0, len(new))]]
    out: list[str] = []
    for group in groups:
        (_, first_old, _, first_new, _), (_, _, last_old, _, last_new) = group[0], group[-1]
        out.append(f"@@ -{_range(first_old, last_old)} +{_range(first_new, last_new)} @@")
        for tag, a, b, c, d in group:
            if tag == "equal":
                out += [f" {line}" for line in old[a:b]]
                continue
            out += [f"-{line}" for line in old[a:b]]
            out += [f"+{line}" for line in new[c:d]]
    return out


def _range(start: int, stop: int) -> str:
    """A range of lines as in `diff -u`."""
    length = stop - start
    return str(start + 1) if length == 1 else f"{start + 1 if length else start},{length}"
