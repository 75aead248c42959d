"""CarRacing: only what can be seen of the road and the grass is transformed and drawn.

Replaces `CarRacing._render_road`. The library transforms all of some 700 polygons in Python, draws those within a
generous distance of the canvas, and paints the background as a polygon that is larger than the canvas. Here:
- a polygon is left out when all of its vertices lie beyond one side of the visible part, by more than MARGIN pixels:
  each of its edges is then rejected by the drawing routine, and its interior has no visible pixel. Most are found
  by their bounding circles, estimated in numpy with an error far below a pixel, the rest by their vertices;
- vertices of the others are computed by the library's operations in its order, and drawn by its calls, in its order;
- the background is filled instead of drawn as a polygon where that polygon covers the canvas.
Serves pictures for people too: they are drawn on the same canvas, under the same panel.

The canvas is 1000 × 800 and upside down until it is flipped; the panel with the indicators is painted afterwards over
what are then its last rows, which are the first ones while the road is drawn.
"""

from __future__ import annotations

import math
from itertools import product
from typing import Any

import numpy as np
from gymnasium.envs.box2d.car_racing import GRASS_DIM, MAX_SHAPE_DIM, PLAYFIELD, WINDOW_H, WINDOW_W, CarRacing
from numpy.typing import NDArray
from pygame import gfxdraw
from pygame.math import Vector2

from evopolicy_worker.environments.accelerations.specialise import specialise

PANEL_ROWS = WINDOW_H // 8
"""Rows under the panel: five units of a fortieth of the height."""
ROAD_ROWS = WINDOW_H - PANEL_ROWS
VISIBLE = (0, PANEL_ROWS, WINDOW_W, ROAD_ROWS)
"""The part of the canvas, before the flip, of which pixels reach the picture: x, y, width, height."""
MARGIN = 4.0
"""Pixels. More than rounding to whole pixels and the smoothing of edges can reach."""
_LEFT, _RIGHT = -MARGIN, WINDOW_W + MARGIN
_TOP, _BOTTOM = PANEL_ROWS - MARGIN, WINDOW_H + MARGIN
_FAR_RIGHT, _FAR_BOTTOM = WINDOW_W + MAX_SHAPE_DIM, WINDOW_H + MAX_SHAPE_DIM
"""The library's own bounds, within which one of the vertices must be."""


def covers(zoom: float, translation: tuple[float, float], angle: float) -> bool:
    """Whether the playing field, the first polygon to be drawn, covers the canvas with MARGIN to spare on every
    side."""
    cos, sin = math.cos(angle), math.sin(angle)
    for corner_x, corner_y in product((_LEFT, _RIGHT), (-MARGIN, _BOTTOM)):
        x, y = corner_x - translation[0], corner_y - translation[1]
        # Rotated back, into the axes of the field.
        if max(abs(x * cos + y * sin), abs(y * cos - x * sin)) >= PLAYFIELD * zoom:
            return False
    return True


class _Polygons:
    """Polygons of four vertices in world coordinates, and the circles around them."""

    def __init__(self, polygons: list[Any]) -> None:
        self.vertices = [[Vector2(vertex) for vertex in polygon] for polygon in polygons]
        corners = np.array([list(polygon) for polygon in polygons], dtype=np.float64)
        centres = corners.mean(axis=1)
        self._x, self._y = np.ascontiguousarray(centres.T)
        self._radius: NDArray[np.float64] = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)

    def near(self, zoom: float, translation: tuple[float, float], angle: float) -> list[int]:
        """Indices of those whose circles reach the visible part of the canvas, ascending."""
        cos, sin = zoom * math.cos(angle), zoom * math.sin(angle)
        reach = self._radius * zoom + MARGIN
        x = self._x * cos - self._y * sin + (translation[0] - WINDOW_W / 2)
        y = self._x * sin + self._y * cos + (translation[1] - PANEL_ROWS - ROAD_ROWS / 2)
        inside = (np.abs(x) < reach + WINDOW_W / 2) & (np.abs(y) < reach + ROAD_ROWS / 2)
        return np.flatnonzero(inside).tolist()


_GRASS = _Polygons(
    [
        [
            (GRASS_DIM * x + GRASS_DIM * right, GRASS_DIM * y + GRASS_DIM * up)
            for right, up in ((1, 0), (0, 0), (0, 1), (1, 1))
        ]
        for x, y in product(range(-20, 20, 2), repeat=2)
    ]
)
"""The library's patches, in its order."""


class VisibleRoad(CarRacing):
    """Keeps the polygons of the present track in a form in which they are quickly sorted out."""

    _tiles: _Polygons
    _tiles_of: Any = None
    """The `road_poly` of which `_tiles` are; a reset makes a new list."""

    def _render_road(self, zoom: float, translation: Any, angle: float) -> None:
        if self._tiles_of is not self.road_poly:
            self._tiles = _Polygons([polygon for polygon, _ in self.road_poly])
            self._tiles_of = self.road_poly
        surface: Any = self.surf
        if covers(zoom, translation, angle):
            surface.fill(self.bg_color, VISIBLE)
        else:
            field = [(PLAYFIELD * x, PLAYFIELD * y) for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
            draw: Any = self._draw_colored_polygon
            draw(surface, field, self.bg_color, zoom, translation, angle, clip=False)
        for index in _GRASS.near(zoom, translation, angle):
            _draw(surface, _GRASS.vertices[index], self.grass_color, zoom, translation, angle)
        for index in self._tiles.near(zoom, translation, angle):
            # A tile's color changes when the car touches it.
            color = [int(c) for c in self.road_poly[index][1]]
            _draw(surface, self._tiles.vertices[index], color, zoom, translation, angle)


def _draw(
    surface: Any,
    vertices: list[Vector2],
    color: Any,
    zoom: float,
    translation: tuple[float, float],
    angle: float,
) -> None:
    """The library's `_draw_colored_polygon`, less what cannot be seen."""
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = polygon = [
        (turned[0] * zoom + translation[0], turned[1] * zoom + translation[1])
        for turned in [vertex.rotate_rad(angle) for vertex in vertices]
    ]
    if (
        (x0 < _LEFT and x1 < _LEFT and x2 < _LEFT and x3 < _LEFT)
        or (x0 > _RIGHT and x1 > _RIGHT and x2 > _RIGHT and x3 > _RIGHT)
        or (y0 < _TOP and y1 < _TOP and y2 < _TOP and y3 < _TOP)
        or (y0 > _BOTTOM and y1 > _BOTTOM and y2 > _BOTTOM and y3 > _BOTTOM)
    ):
        return
    if any(-MAX_SHAPE_DIM <= x <= _FAR_RIGHT and -MAX_SHAPE_DIM <= y <= _FAR_BOTTOM for x, y in polygon):
        gfxdraw.aapolygon(surface, polygon, color)
        gfxdraw.filled_polygon(surface, polygon, color)


def accelerate(env: Any) -> None:
    specialise(env, VisibleRoad)
