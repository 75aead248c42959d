"""Groups published results that are one comparison. Pure."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from evopolicy_results.leaderboard.bundles import LabBundle
from evopolicy_results.reading.comparability import mixtures
from evopolicy_results.reading.records import Run


class Board(msgspec.Struct, kw_only=True):
    """Bundles whose runs are one comparison."""

    bundles: list[LabBundle]
    apart: list[str] = []
    """How its runs differ from those of the first board; empty for the first board."""
    mixed: bool = False
    """A single bundle whose own runs are no one comparison."""
    unrecorded: bool = False
    """Its runs have episodes without a recording."""

    @property
    def runs(self) -> list[Run]:
        return [each.run for bundle in self.bundles for each in bundle.runs]


def boards(bundles: Sequence[LabBundle]) -> list[Board]:
    """The boards, the one with most runs first. A bundle joins the first board that it is comparable with. Its runs
    with episodes that have no recording stand on boards of their own, after the others."""
    found: list[Board] = []
    parts = [
        (unrecorded, msgspec.structs.replace(bundle, runs=runs))
        for bundle in bundles
        for unrecorded in (False, True)
        if not bundle.refused and (runs := [one for one in bundle.runs if one.unrecorded == unrecorded])
    ]
    for unrecorded, bundle in sorted(parts, key=lambda part: (-len(part[1].runs), part[1].file)):
        own = [each.run for each in bundle.runs]
        if mixtures(own):
            found.append(Board(bundles=[bundle], mixed=True, unrecorded=unrecorded))
            continue
        alike = [board for board in found if not board.mixed and board.unrecorded == unrecorded]
        home = next((board for board in alike if not mixtures([*board.runs, *own])), None)
        if home is None:
            found.append(Board(bundles=[bundle], unrecorded=unrecorded))
        else:
            home.bundles.append(bundle)
    found.sort(key=lambda board: (board.unrecorded, board.mixed, -len(board.runs)))
    for board in found:
        if board.unrecorded:
            board.apart.append(
                "some of their episodes have no recording, so that no replay can contradict the returns"
            )
        if board is not found[0]:
            whole = board.runs if board.mixed else [*found[0].runs, *board.runs]
            board.apart += [str(one) for one in mixtures(whole)]
    return found
