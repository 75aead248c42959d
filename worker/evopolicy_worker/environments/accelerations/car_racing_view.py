"""What the accelerations of CarRacing share: which part of its canvas counts, and when the background fills it.

The canvas is 1000 × 800 and upside down until it is flipped; the panel with the indicators is painted afterwards over
what are then its last rows, which are the first ones while the road is drawn.
"""

from __future__ import annotations

import math

from gymnasium.envs.box2d.car_racing import PLAYFIELD, WINDOW_H, WINDOW_W

PANEL_ROWS = WINDOW_H // 8
"""Rows under the panel: five units of a fortieth of the height."""
ROAD_ROWS = WINDOW_H - PANEL_ROWS
VISIBLE = (0, PANEL_ROWS, WINDOW_W, ROAD_ROWS)
"""The part of the canvas, before the flip, of which pixels reach the picture: x, y, width, height."""
MARGIN = 4.0
"""Pixels. More than rounding to whole pixels and the smoothing of edges can reach."""


def covers(zoom: float, translation: tuple[float, float], angle: float) -> bool:
    """Whether the playing field, the first polygon to be drawn, covers the canvas with MARGIN to spare on every
    side."""
    cos, sin = math.cos(angle), math.sin(angle)
    limit = PLAYFIELD * zoom
    for corner_x in (-MARGIN, WINDOW_W + MARGIN):
        for corner_y in (-MARGIN, WINDOW_H + MARGIN):
            x, y = corner_x - translation[0], corner_y - translation[1]
            # Rotated back, into the axes of the field.
            if abs(x * cos + y * sin) >= limit or abs(y * cos - x * sin) >= limit:
                return False
    return True
