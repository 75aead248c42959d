"""CarRacing: the drawn canvas becomes the 96 × 96 observation with less copying.

Replaces `CarRacing._render` for observations; pictures for people are the library's. The library makes a new canvas of
1000 × 800, draws, flips it into another new one, paints the panel over its lower eighth, loads a font to write the
score, and scales the whole down. Here:
- pygame scales in two passes, columns first, each row by itself, into whole bytes, and rows second (`scalesmooth.c`,
  when both sides shrink; each pass is left out when its length stays). So the first pass may be made before the flip,
  which then has a tenth of the pixels to move, and the rows below the panel need not be scaled at all: the panel
  is painted on a canvas of its own, and both parts meet between the passes (`holds` tries this on noise, for
  there is a routine for every kind of processor);
- canvases are kept, and cleared unless the background is painted all over them;
- the font is loaded once.
Indicators that reach out of the panel (above 150 units of speed or 295 of a wheel's) are left to the library.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pygame
from gymnasium.envs.box2d.car_racing import SCALE, STATE_H, STATE_W, WINDOW_H, WINDOW_W, ZOOM, CarRacing

from evopolicy_worker.environments.accelerations.car_racing_road import PANEL_ROWS, ROAD_ROWS, VISIBLE, covers
from evopolicy_worker.environments.accelerations.specialise import specialise

FONT_SIZE = 42
SPEED_LIMIT = 150.0
"""The panel is five rows high; a bar starts at the first and is 0.02 × speed long."""
OMEGA_LIMIT = 295.0
"""As above, for a bar of 0.01 × the wheel's angular velocity."""


class _Canvases:
    """Surfaces and the font, used by one environment again and again."""

    def __init__(self) -> None:
        self._font = _load_font()
        self.road = pygame.Surface((WINDOW_W, WINDOW_H))
        self.visible = self.road.subsurface(VISIBLE)
        self.narrow_road = pygame.Surface((STATE_W, ROAD_ROWS))
        self.whole = pygame.Surface((WINDOW_W, WINDOW_H))
        """The library draws the panel at its place on a whole canvas; nothing else of it is used."""
        self.panel = self.whole.subsurface((0, ROAD_ROWS, WINDOW_W, PANEL_ROWS))
        self.narrow_panel = pygame.Surface((STATE_W, PANEL_ROWS))
        self.narrow = pygame.Surface((STATE_W, WINDOW_H))
        self.small = pygame.Surface((STATE_W, STATE_H))

    def text(self, words: str) -> pygame.Surface:
        """White on black, as the library writes the score."""
        white, black = (255, 255, 255), (0, 0, 0)
        try:
            return self._font.render(words, True, white, black)
        except pygame.error:
            # Another environment of this process was closed, and with it pygame and all its fonts.
            self._font = _load_font()
            return self._font.render(words, True, white, black)

    def shrink(self) -> None:
        """The road, flipped, above the panel, scaled down to the small picture."""
        scale = pygame.transform.smoothscale
        scale(self.visible, (STATE_W, ROAD_ROWS), self.narrow_road)
        scale(self.panel, (STATE_W, PANEL_ROWS), self.narrow_panel)
        self.narrow.blit(pygame.transform.flip(self.narrow_road, False, True), (0, 0))
        self.narrow.blit(self.narrow_panel, (0, ROAD_ROWS))
        scale(self.narrow, (STATE_W, STATE_H), self.small)


def _load_font() -> pygame.font.Font:
    pygame.font.init()
    return pygame.font.Font(pygame.font.get_default_font(), FONT_SIZE)


class NarrowFrames(CarRacing):
    """An observation made in two passes."""

    _canvases: _Canvases | None = None

    def _render(self, mode: str) -> Any:
        # The library's own attributes are untyped.
        env: Any = self
        car = env.car
        if mode != "state_pixels" or "t" not in self.__dict__ or not _fits(car):
            return super()._render(mode)
        if self._canvases is None:
            self._canvases = _Canvases()
        canvases = self._canvases
        if env.clock is None:
            env.clock = pygame.time.Clock()

        env.surf = canvases.road
        angle = -car.hull.angle
        zoom = 0.1 * SCALE * max(1 - self.t, 0) + ZOOM * SCALE * min(self.t, 1)
        scroll = (-(car.hull.position[0]) * zoom, -(car.hull.position[1]) * zoom)
        turned = pygame.math.Vector2(scroll).rotate_rad(angle)
        translation = (WINDOW_W / 2 + turned[0], WINDOW_H / 4 + turned[1])
        if not covers(zoom, translation, angle):
            env.surf.fill(0)
        env._render_road(zoom, translation, angle)
        car.draw(env.surf, zoom, translation, angle, False)

        env.surf = canvases.whole
        env._render_indicators(WINDOW_W, WINDOW_H)
        text = canvases.text(f"{self.reward:04.0f}")
        place = text.get_rect()
        place.center = (60, WINDOW_H - WINDOW_H * 2.5 / 40.0)
        env.surf.blit(text, place)

        canvases.shrink()
        pixels = bytearray(pygame.image.tobytes(canvases.small, "RGB"))
        return np.frombuffer(pixels, dtype=np.uint8).reshape(STATE_H, STATE_W, 3)


def _fits(car: Any) -> bool:
    """Whether the indicators stay within the panel."""
    x, y = car.hull.linearVelocity
    return x * x + y * y < SPEED_LIMIT**2 and all(wheel.omega < OMEGA_LIMIT for wheel in car.wheels)


@cache
def holds() -> bool:
    """Whether this machine's scaling routine, one of several, works in two passes as described."""
    canvases = _Canvases()
    noise = np.random.default_rng(0).integers(0, 256, size=(WINDOW_W, WINDOW_H, 3), dtype=np.uint8)
    flipped = pygame.surfarray.make_surface(noise)
    canvases.road.blit(pygame.transform.flip(flipped, False, True), (0, 0))
    canvases.whole.blit(flipped, (0, 0))
    expected = pygame.transform.smoothscale(canvases.whole, (STATE_W, STATE_H))
    canvases.shrink()
    return bool(pygame.image.tobytes(canvases.small, "RGB") == pygame.image.tobytes(expected, "RGB"))


def accelerate(env: Any) -> None:
    specialise(env, NarrowFrames)
