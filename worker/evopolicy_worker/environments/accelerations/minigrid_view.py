"""MiniGrid: the agent's view read straight off the grid.

Replaces `MiniGridEnv.gen_obs`, which copies the 7 × 7 window into a new grid of walls and cells, rotates that up to
four times cell by cell, spreads visibility through a mask array, and encodes what is left one cell after the other.
Here the cells are read row by row, away from the agent, in its own axes; a row's visibility is seven bits, and what it
passes on to the next depends only on these and on which of its cells are transparent, so it is looked up in a table
that is filled by the library's rule; behind a row of which nothing is seen there is nothing to read. All of it is
integers and object identity; cells still tell themselves what they are (`encode`, `see_behind`). With see-through walls
or a view of another size the library's method is used.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from minigrid.core.world_object import Wall
from minigrid.minigrid_env import MiniGridEnv

from evopolicy_worker.environments.accelerations.specialise import specialise

SIZE = 7
_MIDDLE = SIZE // 2
_CELL = 3
"""Bytes: kind, color, state."""
_FORWARD = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""By direction of the agent: right, down, left, up."""
_EMPTY = b"\x01\x00\x00"
_OUTSIDE = Wall()


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
        forward_x, forward_y = _FORWARD[self.agent_dir]
        right_x, right_y = -forward_y, forward_x
        left_x = int(self.agent_pos[0]) - _MIDDLE * right_x
        left_y = int(self.agent_pos[1]) - _MIDDLE * right_y
        image = bytearray(SIZE * SIZE * _CELL)
        seen = 1 << _MIDDLE
        for row in range(SIZE - 1, -1, -1):
            x, y = left_x, left_y
            line = []
            clear, bit = 0, 1
            for _ in range(SIZE):
                if 0 <= x < width and 0 <= y < height:
                    cell = cells[y * width + x]
                    if cell is None or (type(cell) is not Wall and cell.see_behind()):
                        clear |= bit
                else:
                    cell = _OUTSIDE
                line.append(cell)
                bit += bit
                x += right_x
                y += right_y
            seen, behind = _row(seen, clear)
            if row == SIZE - 1:
                line[_MIDDLE] = self.carrying or None
            place = row * _CELL
            for column in range(SIZE):
                if seen >> column & 1:
                    cell = line[column]
                    image[place : place + _CELL] = _EMPTY if cell is None else bytes(cell.encode())
                place += SIZE * _CELL
            if not behind:
                break
            seen = behind
            left_x += forward_x
            left_y += forward_y
        return {
            "image": np.frombuffer(image, dtype=np.uint8).reshape(SIZE, SIZE, _CELL),
            "direction": self.agent_dir,
            "mission": self.mission,
        }


def accelerate(env: Any) -> None:
    specialise(env, DirectView)
