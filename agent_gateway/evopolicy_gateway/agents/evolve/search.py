"""The strategy, pure: which candidates to try next, given the results of the earlier ones. No clock, disk or network.

- An *opening* tries candidates of every family once. Each later *round* tries the survivors again together with their
  mutants, all on the same case, so that only the candidates differ. *Finals* try single candidates, each a checkpoint.
- A return is modelled as candidate effect + case effect (fitted by alternating means), so that candidates that played
  different cases are comparable. A candidate's worth is its effect, shrunk towards its family's mean while it has few
  episodes, since the best of many single returns is mostly luck.
- If most returns are equal (a sparse reward that hardly any candidate has reached), novelty is added to them, and a
  round is spread over cases, since a case on which no candidate gets the reward teaches nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np

from evopolicy_gateway.agents.evolve.families import Family, Vector

MEAN_AFTER = 2
"""The mean of the best becomes a final after this many others."""
SURVIVING_SHARE = 0.35
"""Share of a round that re-tries survivors."""
FIRST_STRENGTH, STRENGTH_DECAY = 0.8, 0.7
"""Mutation strength of the first round after the opening, and its factor from round to round."""
SPARSE_SHARE = 0.6
"""Returns are sparse when more than this share of them is equal."""
NOISY_RATIO, VERY_NOISY_RATIO = 0.5, 1.2
"""Ratios of noise variance to that of candidate effects above which a candidate plays two and four cases per round."""
TIED_SHARE = 0.15
"""Share of a round with the best return above which one case counts as too easy."""
NOVELTY_BONUS = 0.3
"""Bonus of the most novel episode while returns are sparse, in units of the returns' range."""
MAX_PER_FAMILY = 0.6
"""Largest share of the survivors in one family, so that an early lucky family does not displace all others."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One episode that a candidate played."""

    case: int
    """Train case id."""
    episode_return: float
    novelty: float = 0.0
    """Number of different observations in it; 0 if it was not determined."""


@dataclass(kw_only=True, eq=False)
class Candidate:
    """One parametrised controller, and all its episodes so far."""

    family: Family
    vector: Vector
    episodes: list[Episode] = field(default_factory=list)
    is_final: bool = False
    """Whether it had a checkpoint of its own."""

    def as_json(self) -> dict[str, Any]:
        """Its entry in `candidates.json`."""
        vector = [float(f"{value:.7g}") for value in self.vector]
        return {"kind": self.family.kind, "vector": vector, "settings": self.family.settings}


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The division of a budget, in episodes."""

    opening: int
    rounds: tuple[int, ...]
    finals: int
    """Least number of finals; unused budget adds more."""
    episodes_per_final: int


def make_plan(budget: int, min_per_submit: int, max_per_submit: int) -> Plan:
    """A plan for `budget` ≥ 1 episodes within the bounds of a submit.

    A small budget goes into finals, since each is evaluated again on the hidden validation cases; a large one into
    search.
    """
    per_final = max(min_per_submit, min(3, budget // 32, max_per_submit), 1)
    share = 0.5 if budget <= 16 else 0.35 if budget <= 64 else 0.28
    n_finals = max(1, min(10, int(budget * share) // per_final))
    searching = budget - n_finals * per_final
    most = min(24, max_per_submit)
    if searching < max(2, min_per_submit):
        return Plan(opening=0, rounds=(), finals=max(1, budget // per_final), episodes_per_final=per_final)
    first = searching if searching <= 16 else max(searching // 3, min(2 * searching // 3, most))
    opening = min(max(first, min_per_submit), max_per_submit)
    fresh = searching - opening
    least = max(4, min_per_submit)
    n_rounds = min(-(-fresh // max(most, least)), fresh // least)
    rounds = tuple(min(fresh // n_rounds + (i < fresh % n_rounds), max_per_submit) for i in range(n_rounds))
    rounds = tuple(size for size in rounds if size >= min_per_submit)
    return Plan(opening=opening, rounds=rounds, finals=n_finals, episodes_per_final=per_final)


class Search:
    """Holds all candidates and proposes the next ones."""

    def __init__(self, families: Iterable[Family], rng: np.random.Generator) -> None:
        self._rng = rng
        self._families = list(families)
        self._sources = {family.name: family.sample(rng) for family in self._families}
        self._newcomers: list[Family] = []
        self._round = 0
        self.candidates: list[Candidate] = []

    def add_family(self, family: Family) -> None:
        """Adds a family that feedback made possible: its first candidates join the next round.

        For a family with a known name only the settings are updated, for all of its candidates: they describe the
        environment and are not part of the search.
        """
        for known in self._families:
            if known.name == family.name:
                known.settings.update(family.settings)
                return
        self._families.append(family)
        self._sources[family.name] = family.sample(self._rng)
        self._newcomers.append(family)

    def opening(self, n: int) -> list[Candidate]:
        """Draws `n` new candidates, from the families in turn."""
        drawn: list[Candidate] = []
        sources = list(self._families)
        while len(drawn) < n and sources:
            for family in list(sources):
                # A small opening shows every family once before any twice.
                share = family.weight if n > 2 * len(self._families) else 1
                batch = self._drawn(family, share)
                drawn += batch
                if len(batch) < share:
                    sources.remove(family)
        self.candidates += drawn[:n]
        return drawn[:n]

    def round(self, n: int) -> list[Candidate]:
        """Survivors and their mutants, `n` together."""
        strength = FIRST_STRENGTH * STRENGTH_DECAY**self._round
        self._round += 1
        fresh = [one for family in self._newcomers for one in self._drawn(family, max(2, n // 3))]
        self._newcomers.clear()
        fresh = fresh[: n // 2]
        survivors = self._survivors(max(1, round((n - len(fresh)) * SURVIVING_SHARE)))
        n_mutants = n - len(fresh) - len(survivors)
        fresh += [self._mutant(survivors, strength) for _ in range(n_mutants)]
        self.candidates += fresh
        return survivors + fresh

    def finalist(self) -> Candidate:
        """The next candidate for a checkpoint of its own.

        Alternates between the best one without a checkpoint and the best of a family seldom chosen so far: the hidden
        validation plays more cases than the search did, so a hedge against a lucky leader costs little.
        """
        taken = [c for c in self.candidates if c.is_final]
        candidates = [c for c in _distinct(taken, self.ranking()) if not c.is_final]
        if not candidates:
            candidates = self.opening(1) or self.ranking() or self.candidates
        chosen = candidates[0]
        if len(taken) == MEAN_AFTER:
            chosen = self._mean_of_best() or chosen
        elif len(taken) % 2:
            worth = self.worth()
            bar = self._hedge_bar(worth)
            able = [c for c in candidates if worth.get(id(c), bar) >= bar] or candidates[:1]
            finals = [c.family.name for c in taken]
            chosen = min(able, key=lambda c: finals.count(c.family.name))
        chosen.is_final = True
        return chosen

    def ranking(self) -> list[Candidate]:
        """All evaluated candidates, best first."""
        worth = self.worth()
        return sorted(self._tried, key=lambda c: worth[id(c)], reverse=True)

    def worth(self) -> dict[int, float]:
        """By `id` of each evaluated candidate: its effect, shrunk towards its family's mean if it has few episodes."""
        tried = self._tried
        if not tried:
            return {}
        effects, ratio = self._effects(tried)
        counts = np.array([len(c.episodes) for c in tried])
        owner = np.unique([c.family.name for c in tried], return_inverse=True)[1]
        family_mean = (np.bincount(owner, effects) / np.bincount(owner))[owner]
        # As many imagined episodes at the family's mean as the noise is worth against the differences.
        imagined = max(ratio, 1.0 if self.is_sparse else 0.0)
        shrunk = (counts * effects + imagined * family_mean) / (counts + imagined)
        return {id(c): float(value) for c, value in zip(tried, shrunk, strict=True)}

    @property
    def repeats(self) -> int:
        """Number of cases that each candidate of the next round should play: more if one does not distinguish them."""
        tried = self._tried
        if not tried or np.ptp(self._returns) < 1e-9:
            return 1
        if (
            self.is_sparse or max(len(c.episodes) for c in tried) < 2
        ):  # else nothing is known of the noise yet
            return 2
        latest = [c.episodes[-1] for c in tried]
        last = [e.episode_return for e in latest if e.case == latest[-1].case]
        tied = last.count(max(last)) > len(last) * TIED_SHARE
        ratio = self._effects(tried)[1]
        return 4 if ratio > VERY_NOISY_RATIO else 2 if tied or ratio > NOISY_RATIO else 1

    def _effects(self, tried: list[Candidate]) -> tuple[Vector, float]:
        """Effects of `tried`, and the noise variance of one episode over the variance of the better half's effects,
        ≤ 2."""
        effects, noise = _fit(self._scores(tried))
        better = np.sort(effects)[len(effects) // 2 :]
        return effects, min(noise**2 / max(float(np.var(better)), 1e-12), 2.0)

    @property
    def _tried(self) -> list[Candidate]:
        return [c for c in self.candidates if c.episodes]

    @property
    def _returns(self) -> list[float]:
        return [e.episode_return for c in self.candidates for e in c.episodes]

    @property
    def is_sparse(self) -> bool:
        """True while most returns are equal."""
        returns = self._returns
        equal = np.isclose(returns, np.median(returns), rtol=0.0, atol=1e-9) if returns else np.zeros(1)
        return bool(equal.mean() > SPARSE_SHARE)

    def _scores(self, tried: list[Candidate]) -> list[list[tuple[int, float]]]:
        """Per candidate, (case, score) of its episodes: the returns, with a bonus for novelty while they are sparse."""
        bonus = 0.0
        if self.is_sparse:
            most = max(e.novelty for c in tried for e in c.episodes) or 1.0
            bonus = NOVELTY_BONUS * (float(np.ptp(self._returns)) or 1.0) / most
        return [[(e.case, e.episode_return + bonus * e.novelty) for e in c.episodes] for c in tried]

    def _hedge_bar(self, worth: dict[int, float]) -> float:
        """The least worth of a hedge: near the leader's if returns are reliable, down to the median if they are not."""
        values = np.array(list(worth.values()) or [0.0])
        doubt = min(1.0, self._effects(self._tried)[1]) if self._tried else 1.0
        best = float(values.max())
        return best - (0.25 + 0.75 * doubt) * (best - float(np.median(values)))

    def _survivors(self, n: int) -> list[Candidate]:
        ranked = self.ranking()
        limit = max(1, int(np.ceil(n * MAX_PER_FAMILY)))
        kept: list[Candidate] = []
        for candidate in ranked:
            if len(kept) < n and [c.family for c in kept].count(candidate.family) < limit:
                kept.append(candidate)
        return kept + [c for c in ranked if c not in kept][: n - len(kept)]

    def _mutant(self, parents: list[Candidate], strength: float) -> Candidate:
        """Mutates a parent, preferring better ones: a random step, half the time after a step towards a relative."""
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
        return Candidate(family=parent.family, vector=vector + strength * parent.family.scale * step)

    def _draw(self, parents: list[Candidate]) -> Candidate:
        """A new candidate of any family that has candidates left; else the best parent again."""
        order = self._rng.permutation(len(self._families))
        drawn = (one for index in order for one in self._drawn(self._families[int(index)], 1))
        return next(drawn, None) or Candidate(family=parents[0].family, vector=parents[0].vector)

    def _mean_of_best(self) -> Candidate | None:
        """The mean of the leading family's best candidates, as in the cross-entropy method."""
        ranked = self.ranking()
        elite = [c for c in ranked if c.family is ranked[0].family and len(c.episodes) > 1][:3]
        if len(elite) < 2 or not elite[0].family.scale.any():
            return None
        mean = Candidate(family=elite[0].family, vector=np.mean([c.vector for c in elite], axis=0))
        self.candidates.append(mean)
        return mean

    def _drawn(self, family: Family, n: int) -> list[Candidate]:
        return [Candidate(family=family, vector=v) for v in islice(self._sources[family.name], n)]


def _distinct(kept: list[Candidate], ranked: list[Candidate]) -> list[Candidate]:
    """`ranked` without candidates whose returns equal those of a kept or better one on all shared cases."""
    distinct: list[Candidate] = []
    for candidate in ranked:
        if not any(_same_behaviour(candidate, other) for other in (*kept, *distinct)):
            distinct.append(candidate)
    return distinct


def _same_behaviour(one: Candidate, other: Candidate) -> bool:
    returns = {e.case: e.episode_return for e in one.episodes}
    shared = [(returns[e.case], e.episode_return) for e in other.episodes if e.case in returns]
    return bool(shared) and all(a == b for a, b in shared)


def _fit(scores: list[list[tuple[int, float]]]) -> tuple[Vector, float]:
    """Candidate effects of an additive model candidate + case, and the standard deviation of its residuals.

    If no candidate played twice there are no meaningful residuals; the noise is then 0.
    """
    owner = np.array([i for i, played in enumerate(scores) for _ in played])
    cases = np.unique([case for played in scores for case, _ in played], return_inverse=True)[1]
    values = np.array([value for played in scores for _, value in played])
    n_candidates, n_cases = len(scores), int(cases.max()) + 1
    effect, case_effect = np.zeros(n_candidates), np.zeros(n_cases)
    per_candidate, per_case = np.bincount(owner), np.bincount(cases)
    for _ in range(30):
        effect = np.bincount(owner, values - case_effect[cases]) / per_candidate
        case_effect = np.bincount(cases, values - effect[owner]) / per_case
        case_effect -= case_effect.mean()
    residual = values - effect[owner] - case_effect[cases]
    freedom = len(values) - n_candidates - n_cases + 1
    noise = float(np.sqrt((residual**2).sum() / freedom)) if freedom > 0 else 0.0
    return effect, noise
