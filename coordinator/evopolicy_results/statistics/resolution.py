"""The smallest gap that an experiment resolves at 95 %, and the number of repeats that a given gap would need."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from statistics import fmean, median

import msgspec

from evopolicy_results.scoring.normalised import Scale
from evopolicy_results.statistics.pairs import Pair
from evopolicy_results.statistics.repeats import Repeats, Spread, repeats_needed, spread_of
from evopolicy_results.statistics.samples import Sample, matched

GAPS = (0.05, 0.1, 0.2)
"""Gaps on the random-to-best scale for which a report gives the repeats."""


class Resolution(msgspec.Struct, frozen=True, kw_only=True):
    """The gap that one environment can resolve between agents."""

    env: str
    gap: float | None
    """Half width of the 95 % intervals of the differences, median over the pairs of agents, in returns."""
    scale: float | None
    """Best agent's mean minus the random reference's, in returns; None without such a scale."""
    n_cases: int
    n_runs: tuple[int, int]
    """Fewest and most runs of an agent."""
    spread: Spread | None
    """None unless every agent has two or more runs on the same cases: one run does not show how runs vary."""

    @property
    def normalised_gap(self) -> float | None:
        """`gap` as a share of the scale."""
        return None if self.gap is None or self.scale is None else self.gap / self.scale

    def repeats(self, share: float) -> Repeats | None:
        """Runs per agent that resolve a gap of `share` of the scale; None if unknown."""
        if self.spread is None or self.scale is None:
            return None
        return repeats_needed(self.spread, share * self.scale)


def resolutions(
    samples: Mapping[tuple[str, str], Sample],
    found: Sequence[Pair],
    agents: Sequence[str],
    scales: Mapping[str, Scale],
    environments: Sequence[str],
) -> list[Resolution]:
    """One for each environment that two or more agents have played."""
    out: list[Resolution] = []
    for env in environments:
        here = [samples[agent, env] for agent in agents if (agent, env) in samples]
        own = [pair for pair in found if pair.env == env and {pair.first, pair.second} <= set(agents)]
        if len(here) < 2:
            continue
        halves = [
            0.5 * (pair.gap.high - pair.gap.low)
            for pair in own
            if pair.gap is not None and pair.gap.low is not None and pair.gap.high is not None
        ]
        scale = scales.get(env)
        out.append(
            Resolution(
                env=env,
                gap=median(halves) if halves else None,
                scale=None if scale is None else scale.best - scale.random,
                n_cases=max((pair.n_cases for pair in own), default=0),
                n_runs=(min(len(s.runs) for s in here), max(len(s.runs) for s in here)),
                spread=_spread(here),
            )
        )
    return out


def overall(found: Sequence[Resolution]) -> Resolution | None:
    """Resolution of the mean of normalised scores over environments, on which the scale is 1; None unless each
    environment has a scale and a gap. Environments are fixed: the suite is not a sample."""
    gaps = [one.normalised_gap for one in found]
    if not found or any(gap is None for gap in gaps):
        return None
    n = len(found)
    spread = None
    spreads = [(one.spread, one.scale) for one in found]
    if all(one is not None for one, _ in spreads):
        known = [(one, scale) for one, scale in spreads if one is not None and scale is not None]
        spread = Spread(
            run=sum(one.run / scale**2 for one, scale in known) / n**2,
            case=sum(one.case / scale**2 for one, scale in known) / n**2,
            n_cases=sum(one.n_cases for one, _ in known),
        )
    return Resolution(
        env="",
        gap=math.sqrt(sum(gap**2 for gap in gaps if gap is not None)) / n,
        scale=1.0,
        n_cases=sum(one.n_cases for one in found),
        n_runs=(min(one.n_runs[0] for one in found), max(one.n_runs[1] for one in found)),
        spread=spread,
    )


def _spread(samples: Sequence[Sample]) -> Spread | None:
    common = matched(samples)
    if common is None or any(len(matrix) < 2 for matrix in common.returns):
        return None
    found = [spread_of(one, other) for one, other in itertools.combinations(common.returns, 2)]
    return Spread(
        run=fmean(one.run for one in found),
        case=fmean(one.case for one in found),
        n_cases=common.returns[0].shape[1],
    )
