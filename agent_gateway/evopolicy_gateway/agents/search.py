"""The strategy, pure: which candidates to try next, given how the earlier ones did. No clock, disk or network.

- An *opening* tries candidates of every family once; each later *round* re-tries the survivors beside their mutants, all
  on the same case, so that they differ by nothing but themselves; *finals* try single candidates, each a checkpoint.
- A return is explained as candidate effect + case effect (fitted by alternating means), so that candidates that met
  different cases can be compared; a candidate's worth is its effect less a penalty for having been seen seldom.
- Where returns tell nothing apart (a reward that nobody has met yet), novelty stands in for them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np

from evopolicy_gateway.agents.families import Family, Vector

DOUBT = 0.5
"""Penalty of a candidate seen once, in standard deviations of a single return."""
SURVIVING_SHARE = 0.35
"""Share of a round that re-tries survivors."""
FIRST_STRENGTH, STRENGTH_DECAY = 0.8, 0.7
"""Mutation strength of the first round after the opening, and its factor from round to round."""
MAX_PER_FAMILY = 0.6
"""Share of the survivors that one family may hold, so that an early lucky one does not end the race."""


@dataclass(kw_only=True, eq=False)
class Candidate:
    """One parametrised controller, and every return seen of it."""

    family: Family
    vector: Vector
    origin: str
    """How it came about: `opening`, `mutant`, `mean`."""
    returns: list[tuple[int, float]] = field(default_factory=list)
    """(train case, return) of each episode it played."""
    novelties: list[float] = field(default_factory=list)

    def as_json(self) -> dict[str, Any]:
        """As `candidates.json` lists it."""
        return {
            "kind": self.family.kind,
            "vector": [float(f"{value:.7g}") for value in self.vector],
            "settings": self.family.settings,
        }


@dataclass(frozen=True, kw_only=True)
class Plan:
    """How a budget is spent, in episodes."""

    opening: int
    rounds: tuple[int, ...]
    finals: int
    """How many finals at least; what is left over is added to them."""
    episodes_per_final: int


def make_plan(budget: int, min_per_submit: int, max_per_submit: int) -> Plan:
    """A plan for `budget` ≥ 1 episodes that keeps to the bounds of a submit.

    A small budget goes into finals, since each is judged again on the hidden validation cases; a large one into search.
    """
    per_final = max(min_per_submit, min(4, budget // 32, max_per_submit), 1)
    share = 0.5 if budget <= 16 else 0.35 if budget <= 64 else 0.28
    n_finals = max(1, min(8, int(budget * share) // per_final))
    searching = budget - n_finals * per_final
    if searching < max(2, min_per_submit):
        return Plan(opening=0, rounds=(), finals=max(1, budget // per_final), episodes_per_final=per_final)
    opening = min(max(searching // 3, min(searching, 24)), max_per_submit)
    left = searching - opening
    n_rounds = -(-left // min(24, max_per_submit)) if left >= max(4, min_per_submit) else 0
    rounds = tuple(left // n_rounds + (i < left % n_rounds) for i in range(n_rounds))
    if rounds and min(rounds) < min_per_submit:
        rounds = (min_per_submit,) * (left // min_per_submit)
    return Plan(opening=opening, rounds=rounds, finals=n_finals, episodes_per_final=per_final)


class Search:
    """Keeps all candidates and proposes the next ones."""

    def __init__(self, families: Iterable[Family], rng: np.random.Generator) -> None:
        self._rng = rng
        self._families = list(families)
        self._sources = {family.name: family.sample(rng) for family in self._families}
        self._newcomers: list[Family] = []
        self._round = 0
        self.candidates: list[Candidate] = []

    def add_family(self, family: Family) -> None:
        """A family that feedback made possible: its first candidates join the next round."""
        self._families.append(family)
        self._sources[family.name] = family.sample(self._rng)
        self._newcomers.append(family)

    def opening(self, n: int) -> list[Candidate]:
        """`n` new candidates, drawn from the families in turn."""
        drawn: list[Candidate] = []
        sources = list(self._families)
        while len(drawn) < n and sources:
            for family in list(sources):
                vectors = list(islice(self._sources[family.name], family.weight))
                drawn += [Candidate(family=family, vector=v, origin="opening") for v in vectors]
                if len(vectors) < family.weight:
                    sources.remove(family)
        return self._joined(drawn[:n])

    def round(self, n: int) -> list[Candidate]:
        """Survivors and their mutants, `n` together."""
        strength = FIRST_STRENGTH * STRENGTH_DECAY**self._round
        self._round += 1
        fresh = [
            Candidate(family=family, vector=vector, origin="opening")
            for family in self._newcomers
            for vector in islice(self._sources[family.name], max(2, n // 3))
        ]
        self._newcomers.clear()
        fresh = fresh[: n // 2]
        survivors = self._survivors(max(1, round((n - len(fresh)) * SURVIVING_SHARE)))
        n_mutants = n - len(fresh) - len(survivors)
        fresh += [self._mutant(survivors, strength) for _ in range(n_mutants)]
        return survivors + self._joined(fresh)

    def finalists(self, n: int) -> list[Candidate]:
        """`n` candidates worth a checkpoint each: the best, the mean of the best's family, the best of other families."""
        ranked = self.ranking()
        if not ranked:
            return self.opening(n)
        chosen = ranked[: max(1, n // 2)]
        mean = self._mean_of_best(ranked)
        if mean is not None and n >= 4:
            chosen += self._joined([mean])
        for family in {c.family.name: c.family for c in ranked}.values():
            best = next(c for c in ranked if c.family is family)
            if best not in chosen:
                chosen.append(best)
        chosen += [c for c in ranked if c not in chosen]
        if len(chosen) < n:
            chosen += self.opening(n - len(chosen))
        return chosen[:n]

    def ranking(self) -> list[Candidate]:
        """All candidates that were tried, best first."""
        worth = self.worth()
        tried = [c for c in self.candidates if c.returns]
        return sorted(tried, key=lambda c: worth[id(c)], reverse=True)

    def worth(self) -> dict[int, float]:
        """By `id` of each tried candidate: its effect, less the doubt of having been seen seldom."""
        tried = [c for c in self.candidates if c.returns]
        if not tried:
            return {}
        use_novelty = self.is_flat
        effects, noise = _effects([_scores(c, use_novelty) for c in tried])
        counts = [len(c.returns) for c in tried]
        return {
            id(c): effect - DOUBT * noise / np.sqrt(count)
            for c, effect, count in zip(tried, effects, counts, strict=True)
        }

    @property
    def is_flat(self) -> bool:
        """True while, case by case, no return differs from another."""
        by_case: dict[int, list[float]] = {}
        for candidate in self.candidates:
            for case, value in candidate.returns:
                by_case.setdefault(case, []).append(value)
        return all(max(values) - min(values) < 1e-9 for values in by_case.values())

    def _survivors(self, n: int) -> list[Candidate]:
        ranked = self.ranking()
        limit = max(1, int(np.ceil(n * MAX_PER_FAMILY)))
        held: dict[str, int] = {}
        kept: list[Candidate] = []
        for candidate in ranked:
            name = candidate.family.name
            if len(kept) < n and held.get(name, 0) < limit:
                kept.append(candidate)
                held[name] = held.get(name, 0) + 1
        return kept + [c for c in ranked if c not in kept][: n - len(kept)]

    def _mutant(self, parents: list[Candidate], strength: float) -> Candidate:
        """A parent, better ones more often, moved: a random step, half the time on top of a step towards a relative."""
        able = [p for p in parents if p.family.scale.any()]
        if not able:
            return self._draw(parents)
        chances = 0.75 ** np.arange(len(able))
        parent = able[int(self._rng.choice(len(able), p=chances / chances.sum()))]
        relatives = [p for p in able if p.family is parent.family and p is not parent]
        vector = parent.vector.copy()
        if relatives and self._rng.random() < 0.5:
            other = relatives[int(self._rng.integers(len(relatives)))]
            vector += self._rng.uniform(0.0, 0.8) * (other.vector - parent.vector)
        # Many numbers: change some of them only, or the step is long in every case and undoes what works.
        touched = self._rng.random(vector.size) < max(0.3, 3 / max(vector.size, 1))
        step = self._rng.standard_normal(vector.size) * touched
        return Candidate(
            family=parent.family, vector=vector + strength * parent.family.scale * step, origin="mutant"
        )

    def _draw(self, parents: list[Candidate]) -> Candidate:
        """A new candidate of any family that still has some; the best parent again where none has."""
        for index in self._rng.permutation(len(self._families)):
            family = self._families[int(index)]
            for vector in islice(self._sources[family.name], 1):
                return Candidate(family=family, vector=vector, origin="opening")
        return Candidate(family=parents[0].family, vector=parents[0].vector, origin="opening")

    def _mean_of_best(self, ranked: list[Candidate]) -> Candidate | None:
        """The mean of the leading family's best candidates, as the cross-entropy method would have it."""
        family = ranked[0].family
        elite = [c for c in ranked if c.family is family and len(c.returns) > 1][:3]
        if len(elite) < 2 or not family.scale.any():
            return None
        return Candidate(family=family, vector=np.mean([c.vector for c in elite], axis=0), origin="mean")

    def _joined(self, candidates: list[Candidate]) -> list[Candidate]:
        self.candidates += candidates
        return candidates


def _scores(candidate: Candidate, use_novelty: bool) -> list[tuple[int, float]]:
    if not use_novelty or not candidate.novelties:
        return candidate.returns
    cases = [case for case, _ in candidate.returns]
    return list(zip(cases, candidate.novelties, strict=False))


def _effects(scores: list[list[tuple[int, float]]]) -> tuple[list[float], float]:
    """Candidate effects of an additive model candidate + case, and the standard deviation of its residuals.

    Where nobody played twice there are no residuals to speak of: the noise is then 0, as it is the same for all.
    """
    owner = np.array([i for i, played in enumerate(scores) for _ in played])
    cases = np.unique([case for played in scores for case, _ in played], return_inverse=True)[1]
    values = np.array([value for played in scores for _, value in played])
    n_candidates, n_cases = len(scores), int(cases.max()) + 1
    effect, case_effect = np.zeros(n_candidates), np.zeros(n_cases)
    for _ in range(30):
        effect = np.bincount(owner, values - case_effect[cases], n_candidates) / np.bincount(
            owner, minlength=n_candidates
        )
        case_effect = np.bincount(cases, values - effect[owner], n_cases) / np.bincount(cases, minlength=n_cases)
        case_effect -= case_effect.mean()
    residual = values - effect[owner] - case_effect[cases]
    freedom = len(values) - n_candidates - n_cases + 1
    noise = float(np.sqrt((residual**2).sum() / freedom)) if freedom > 0 else 0.0
    return [float(e) for e in effect], noise
