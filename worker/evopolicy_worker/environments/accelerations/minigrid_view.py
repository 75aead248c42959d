"""MiniGrid: the agent's view read straight off the grid.

Replaces `MiniGridEnv.gen_obs`, which copies the 7 × 7 window into a new grid of walls and cells, rotates that up to
four times cell by cell, spreads visibility through a mask array, and encodes what is left one cell after the other.
Here the cells are read row by row, away from the agent, in its own axes: a row is one slice of the grid's list. A row's
visibility is seven bits, and what it passes on to the next depends only on these and on which of its cells are
transparent, so it is looked up in a table that is filled by the library's rule; behind a row of which nothing is seen
there is nothing to read. All of it is integers and object identity; cells but walls still tell themselves what they are
(`encode`, `see_behind`). With see-through walls or a view of another size the library's method is used.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from minigrid.core.constants import COLOR_NAMES
from minigrid.core.world_object import Wall
from minigrid.minigrid_env import MiniGridEnv

from evopolicy_worker.environments.accelerations.specialise import specialise

SIZE = 7
_MIDDLE = SIZE // 2
_HIDDEN = b"\x00\x00\x00"
"""Of a cell: kind, color, state."""
_FORWARD = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""By direction of the agent: right, down, left, up."""
_EMPTY = b"\x01\x00\x00"
_WALLS = {color: bytes(Wall(color).encode()) for color in COLOR_NAMES}
_OUTSIDE = [Wall()]
_COLUMNS = [[column for column in range(SIZE) if bits >> column & 1] for bits in range(1 << SIZE)]


@cache
def _row(seen: int, clear: int) -> tuple[int, int]:
    """Which cells of a row are seen in the end, and which of the next row are seen through it.

    `seen`: bits of the cells that are seen from the row before; `clear`: those that can be seen through. As
    `Grid.process_vis`: to the right, then to the left, each seen and clear cell shows its neighbour on that side, and
    of the next row the cell behind that neighbour and the one behind itself.
    """
    behind = 0
    for column in range(SIZE - 1):
        if seen >> column & clear >> column & 1:
            seen |= 2 << column
            behind |= 3 << column
    for column in range(SIZE - 1, 0, -1):
        if seen >> column & clear >> column & 1:
            seen |= 1 << (column - 1)
            behind |= 3 << (column - 1)
    return seen, behind


class DirectView(MiniGridEnv):  # type: ignore[misc]
    """An environment that reads the view off its grid."""

    def gen_obs(self) -> Any:
        if self.see_through_walls or self.agent_view_size != SIZE:
            return super().gen_obs()
        grid = self.grid
        cells, width, height = grid.grid, grid.width, grid.height
        x, y = int(self.agent_pos[0]), int(self.agent_pos[1])
        forward_x, forward_y = _FORWARD[self.agent_dir]
        # The cells of a row that are inside the grid: from one column to another, so many cells of its list apart.
        extent, across = (height, forward_x * width) if forward_x else (width, -forward_y)
        beside = y if forward_x else x
        at, first, last = y * width + x, _MIDDLE - beside, _MIDDLE - beside + extent
        if across < 0:
            first, last = SIZE - last, SIZE - first
        first, last = max(first, 0), min(last, SIZE)
        before, after = _OUTSIDE * first, _OUTSIDE * (SIZE - last)
        at += (first - _MIDDLE) * across
        n_inside = (width - x, height - y, x + 1, y + 1)[self.agent_dir]
        parts = [_HIDDEN] * (SIZE * SIZE)
        seen = 1 << _MIDDLE
        for row in range(SIZE - 1, -1, -1):
            if SIZE - row <= n_inside:
                end = at + (last - first) * across
                line = [*before, *cells[at : end if end >= 0 else None : across], *after]
            else:
                line = _OUTSIDE * SIZE
            clear, bit = 0, 1
            for cell in line:
                if cell is None or (type(cell) is not Wall and cell.see_behind()):
                    clear |= bit
                bit += bit
            seen, behind = _row(seen, clear)
            if row == SIZE - 1:
                line[_MIDDLE] = self.carrying or None
            for column in _COLUMNS[seen]:
                cell = line[column]
                if cell is None:
                    told = _EMPTY
                elif type(cell) is Wall:
                    told = _WALLS[cell.color]
                else:
                    told = bytes(cell.encode())
                parts[column * SIZE + row] = told
            if not behind:
                break
            seen = behind
            at += forward_y * width + forward_x
        return {
            "image": np.frombuffer(bytearray().join(parts), dtype=np.uint8).reshape(SIZE, SIZE, 3),
            "direction": self.agent_dir,
            "mission": self.mission,
        }


def accelerate(env: Any) -> None:
    specialise(env, DirectView)
