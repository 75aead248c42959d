"""Floor and ceiling of returns: random actions and the best policy of this repository, for Core16 and an
environment of every family.

`docs/_site/anchors.py` measures both on the same drawn cases and writes `anchors.json`.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files

import msgspec

from evopolicy_common.catalogue.worlds import unchanged


class Measured(msgspec.Struct, frozen=True, kw_only=True):
    """A policy's mean return and its 95 % interval over the cases."""

    mean: float
    low: float | None = None
    high: float | None = None
    """Both None if at most one case has another return than the others."""


class Anchor(msgspec.Struct, frozen=True, kw_only=True):
    """The ends of an environment's scale."""

    random: Measured
    best: Measured
    cases: int
    """How many cases both played."""
    policy: str
    """Folder of the best policy, in the repository."""

    def normalised(self, score: float) -> float:
        """The score with random actions at 0 and the best policy at 1; not clipped."""
        return (score - self.random.mean) / self.width

    @property
    def width(self) -> float:
        """Return between both ends, above 0."""
        return self.best.mean - self.random.mean


@cache
def anchors() -> dict[str, Anchor]:
    """All anchors by id."""
    text = files(__package__).joinpath("anchors.json").read_text("utf-8")
    return msgspec.json.decode(text, type=dict[str, Anchor])


def anchor(env_id: str) -> Anchor | None:
    """The anchor of an environment, None if unknown; a world has that of the environment that it alters."""
    return anchors().get(unchanged(env_id))
