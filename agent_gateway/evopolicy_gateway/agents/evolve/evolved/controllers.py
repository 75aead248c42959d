"""Parametrised controllers: each maps a flat vector of numbers to behaviour.

A controller is built from a candidate: its `kind`, its `vector`, and `settings` identified from feedback.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .grids import GridSeeker
from .pushing import Carrier, Pusher
from .spaces import ActionHead, Features, Given, Schema, Vector, as_image

OSCILLATOR_PERIOD_STEPS = 25.0
"""Period of an oscillator whose tempo is 0; each unit of tempo halves it."""
SALIENCY_FEATURES = 4
"""Left-right and up-down balance and mean of the salient colour, and a constant 1."""


class Constant:
    """The same outputs at every step."""

    def __init__(self, given: Given, vector: Vector) -> None:
        self._action = given.head.action(vector)

    def act(self, obs: Any) -> Any:
        return self._action


class Linear:
    """Outputs = tanh(W · features + b); a large W makes it bang-bang."""

    def __init__(self, given: Given, vector: Vector) -> None:
        self._head, self._features = given.head, Features(given.obs_space)
        weights = vector.reshape(self._head.size, self._features.size + 1)
        self._weights, self._bias = weights[:, :-1], weights[:, -1]

    def act(self, obs: Any) -> Any:
        return self._head.action(np.tanh(self._weights @ self._features.vector(obs) + self._bias))


class Oscillator:
    """Open loop: every output is a sine of one common period, with its own amplitude, phase and offset."""

    def __init__(self, given: Given, vector: Vector) -> None:
        self._head = given.head
        self._radians_per_step = 2 * np.pi / OSCILLATOR_PERIOD_STEPS * 2.0 ** np.clip(vector[0], -3, 3)
        self._amplitude, self._phase, self._offset = vector[1:].reshape(3, self._head.size)
        self._t = 0

    def act(self, obs: Any) -> Any:
        angle = self._radians_per_step * self._t
        self._t += 1
        return self._head.action(self._offset + self._amplitude * np.sin(angle + np.pi * self._phase))


class Explorer:
    """Random choices that prefer what this episode has not yet tried after the same observation.

    An output's score is its logit, less `curiosity` × log(1 + how often it was chosen after the same observation), plus
    `persistence` when it was the last choice, plus Gumbel noise × `temperature`.
    """

    def __init__(self, given: Given, vector: Vector) -> None:
        self._head, self._rng = given.head, given.rng
        self._logits, (self._curiosity, self._persistence, temperature) = vector[:-3], vector[-3:]
        self._temperature = abs(temperature)
        self._counts: dict[bytes, Vector] = {}
        self._last = np.zeros(self._head.size)

    def act(self, obs: Any) -> Any:
        tried = self._counts.setdefault(fingerprint(obs), np.zeros(self._head.size))
        noise = self._rng.gumbel(size=self._head.size)
        scores = self._logits - self._curiosity * np.log1p(tried)
        scores = scores + self._persistence * self._last + self._temperature * noise
        choice = int(np.argmax(scores))
        tried[choice] += 1
        self._last = np.eye(self._head.size)[choice]
        return self._head.action(self._last if self._head.size else scores)


class Saliency:
    """Steers by the position of a colour in a picture: outputs are linear in that colour's balance and mean.

    The first three numbers weight the colour channels (one channel counts as three equal ones).
    """

    def __init__(self, given: Given, vector: Vector) -> None:
        self._head, self._schema = given.head, given.obs_space
        self._colour = vector[:3]
        self._weights = vector[3:].reshape(self._head.size, SALIENCY_FEATURES)

    def act(self, obs: Any) -> Any:
        image = as_image(obs, self._schema)
        channels = image[:, :, :3] if image.shape[2] >= 3 else np.repeat(image[:, :, :1], 3, axis=2)
        salient = channels @ self._colour
        height, width = salient.shape
        across, down = np.linspace(-1, 1, width), np.linspace(-1, 1, height)
        balance = salient - salient.mean()
        features = np.array(
            [4 * (balance * across).mean(), 4 * (balance * down[:, None]).mean(), salient.mean(), 1.0]
        )
        return self._head.action(np.tanh(self._weights @ features))


def fingerprint(obs: Any) -> bytes:
    """Bytes that are equal for equal observations; numbers are rounded to two decimals."""
    if isinstance(obs, str):
        return obs.encode()
    if isinstance(obs, dict):
        obs = tuple(obs[key] for key in sorted(obs))
    try:
        values = None if isinstance(obs, tuple) else np.asarray(obs)
    except ValueError:  # lists of different lengths: a tuple, as JSON has it
        values = None
    if values is None:
        return b"".join(map(fingerprint, obs))
    return np.round(values, 2).tobytes() if values.dtype.kind == "f" else values.tobytes()


_CONTROLLERS = {
    "constant": Constant,
    "linear": Linear,
    "oscillator": Oscillator,
    "explorer": Explorer,
    "saliency": Saliency,
    "pusher": Pusher,
    "carrier": Carrier,
    "seeker": GridSeeker,
}


def build(
    kind: str,
    vector: Vector,
    settings: dict[str, Any],
    obs_space: Schema,
    action_space: Schema,
    rng: np.random.Generator,
) -> Any:
    """A new controller for one episode, with a method `act(obs)`. Raises KeyError for an unknown kind."""
    return _CONTROLLERS[kind](Given(ActionHead(action_space), obs_space, settings, rng), vector)
