"""The search: how a budget is planned, what is kept, what is drawn next."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from evopolicy_gateway.agents.evolve.families import families_for
from evopolicy_gateway.agents.evolve.search import Candidate, Episode, Search, make_plan

BOX = {"type": "Box", "shape": [3], "dtype": "float32", "low": [-1.0] * 3, "high": [1.0] * 3}
DISCRETE = {"type": "Discrete", "n": 3}


def a_search(seed: int = 0) -> Search:
    return Search(families_for(BOX, BOX), np.random.default_rng(seed))


def play(candidates: list[Candidate], case: int, noise: float = 0.0, seed: int = 0) -> None:
    """The best constant is (0.6, -0.3, 0.1); anything but a constant is worth nothing. Cases differ in level."""
    rng = np.random.default_rng([seed, case])
    for candidate in candidates:
        value = -5.0
        if candidate.family.kind == "constant":
            value = -float(np.abs(candidate.vector - [0.6, -0.3, 0.1]).sum())
        candidate.episodes.append(
            Episode(case=case, episode_return=value + 3.0 * case + noise * rng.normal())
        )


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_plan_never_exceeds_the_budget_and_keeps_to_the_bounds(data: st.DataObject) -> None:
    budget = data.draw(st.integers(1, 600))
    most = data.draw(st.integers(1, 200))
    least = data.draw(st.integers(1, min(most, budget)))
    plan = make_plan(budget, least, most)
    spent = plan.opening + sum(plan.rounds) + plan.finals * plan.episodes_per_final
    assert spent <= budget
    assert plan.finals >= 1
    for size in (*([plan.opening] if plan.opening else []), *plan.rounds, plan.episodes_per_final):
        assert least <= size <= most


def test_a_small_budget_has_an_opening_of_every_family_and_several_finals() -> None:
    plan = make_plan(8, 1, 128)
    assert plan.opening >= 2
    assert plan.finals >= 3
    assert len({c.family.name for c in a_search().opening(4)}) == 4


def test_search_improves_on_its_opening() -> None:
    search = a_search()
    play(search.opening(24), case=0)
    first = max(e.episode_return for c in search.candidates for e in c.episodes)
    for number in range(1, 6):
        play(search.round(20), case=number)
    leader = search.finalist()
    assert leader.family.kind == "constant"
    assert -float(np.abs(leader.vector - [0.6, -0.3, 0.1]).sum()) > first + 0.1


def test_candidates_that_met_different_cases_are_compared_by_effect_not_by_level() -> None:
    search = a_search()
    good, bad, bridge = search.opening(3)
    good.episodes.append(Episode(case=0, episode_return=-90.0))
    bridge.episodes += [Episode(case=0, episode_return=-95.0), Episode(case=1, episode_return=5.0)]
    bad.episodes.append(Episode(case=1, episode_return=0.0))
    assert search.ranking() == [good, bridge, bad]


def test_one_lucky_episode_does_not_outrank_a_proven_candidate() -> None:
    search = Search(families_for(BOX, BOX)[:1], np.random.default_rng(0))
    proven, lucky, *others = search.opening(12)
    rng = np.random.default_rng(1)
    for case in range(6):
        for candidate in others:
            candidate.episodes.append(Episode(case=case, episode_return=float(rng.normal(0, 3))))
        proven.episodes.append(Episode(case=case, episode_return=6.0))
    lucky.episodes.append(Episode(case=0, episode_return=7.0))
    assert search.ranking()[0] is proven


def test_novelty_ranks_while_no_reward_was_met() -> None:
    search = Search(families_for(BOX, DISCRETE), np.random.default_rng(0))
    for i, candidate in enumerate(search.opening(6)):
        candidate.episodes.append(Episode(case=0, episode_return=0.0, novelty=float(i)))
    assert search.is_sparse
    explorers = [c for c in search.ranking() if c.family.name == search.ranking()[0].family.name]
    novelties = [c.episodes[0].novelty for c in explorers]
    assert novelties == sorted(novelties, reverse=True)


def test_rounds_meet_two_cases_when_many_share_the_best_return() -> None:
    search = a_search()
    for i, candidate in enumerate(search.opening(20)):
        candidate.episodes.append(Episode(case=0, episode_return=min(float(i), 9.0)))
    assert search.repeats == 2


def test_finalists_differ_in_behaviour() -> None:
    search = a_search()
    play(search.opening(16), case=0)
    twins = [Candidate(family=c.family, vector=c.vector) for c in search.candidates]
    search.candidates += twins
    play(twins, case=0)
    finals = [search.finalist() for _ in range(6)]
    assert len({(c.family.name, c.vector.tobytes()) for c in finals}) == 6
    only_constants = Search(families_for(BOX, DISCRETE)[:1], np.random.default_rng(0))
    assert all(only_constants.finalist() for _ in range(10))  # they never run out


def test_same_seed_proposes_the_same_candidates() -> None:
    vectors = []
    for _ in range(2):
        search = a_search(seed=3)
        play(search.opening(10), case=0)
        vectors.append([c.as_json() for c in search.round(10)])
    assert vectors[0] == vectors[1]
