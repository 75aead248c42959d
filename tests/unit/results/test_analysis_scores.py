"""Ranking and normalisation: the paper's tables, small cases by hand, and properties."""

from __future__ import annotations

import csv
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_common.errors import ConfigError
from evopolicy_results.scoring.scores import (
    Cell,
    RunReturns,
    ScoreTable,
    competition_ranks,
    heldout_returns,
    leaderboard,
    normalised,
    paper_text,
    rank_score,
    read_score_csv,
    scale_between,
)

ENVS = ("gym/acrobot", "gym/racing", "gym/ant5")
FAMILIES = ("gym_box2d", "mujoco", "minigrid", "robotics_driving")


def table(scores: dict[str, dict[str, tuple[float | None, ...]]], reference: str | None = None) -> ScoreTable:
    cells = {
        (e, env): Cell(entry=e, env=env, runs=tuple(RunReturns(score=score) for score in runs))
        for e, row in scores.items()
        for env, runs in row.items()
    }
    return ScoreTable(cells=cells, harness=dict.fromkeys(scores, "test"), reference=reference)


def paper_rows(name: str) -> list[dict[str, str]]:
    """One table of the paper as printed, one dict per row."""
    return list(csv.DictReader(paper_text(name).splitlines()))


def test_paper_table_of_returns_gives_its_aggregate_table_to_the_digit() -> None:
    board = leaderboard(heldout_returns())
    printed = paper_rows("table2_aggregate")
    assert [row.entry for row in board.standings] == [row["entry"] for row in printed]
    for row, expected in zip(board.standings, printed, strict=True):
        assert [f"{row.families[family]:.3f}" for family in FAMILIES] == [
            expected[family] for family in FAMILIES
        ]
        assert f"{row.score:.3f}" == expected["core16"]
        assert (row.wins, row.top2) == (int(expected["wins"]), int(expected["top2"]))
        assert row.n_environments == 16


def test_paper_table_of_returns_gives_its_normalised_table_to_two_decimals() -> None:
    table = heldout_returns()
    result = normalised(table)
    groups = {(group.entry, group.demand): group for group in result.groups}
    for row in paper_rows("normalised_performance"):
        for entry in table.agents:
            of_env, of_group = (entry, row["env"]), (entry, row["demand"])
            value = groups[of_group].value if row["env"] == "mean" else result.cells[of_env]
            assert value is not None
            assert f"{value:.2f}" == row[entry], (row["env"], entry)
    assert groups["GPT-5.5", "synthesis"].n_environments == 5
    assert groups["GPT-5.5", "tuning"].n_environments == 11


def test_ties_share_the_better_rank_and_no_score_ranks_last() -> None:
    ranks = competition_ranks({"a": 1.0, "b": 3.0, "c": 1.0, "d": None, "e": None, "f": -math.inf})
    assert ranks == {"b": 1, "a": 2, "c": 2, "f": 4, "d": 5, "e": 5}


def test_rank_score_spans_one_to_zero_and_needs_two_entries() -> None:
    assert [rank_score(rank, 5) for rank in (1, 2, 3, 5)] == [1.0, 0.75, 0.5, 0.0]
    assert rank_score(1, 1) is None


def test_leaderboard_of_a_small_table_is_as_computed_by_hand() -> None:
    board = leaderboard(
        table(
            {
                "A": {"gym/acrobot": (3.0,), "gym/racing": (1.0,), "gym/ant5": (5.0,)},
                "B": {"gym/acrobot": (2.0,), "gym/racing": (1.0,), "gym/ant5": (None,)},
                "R": {"gym/acrobot": (1.0,), "gym/racing": (0.0,), "gym/ant5": (0.0,)},
            },
            reference="R",
        )
    )
    a, b, r = board.standings
    assert [row.entry for row in board.standings] == ["A", "B", "R"]
    # acrobot 1, .5, 0; racing 1, 1, 0; ant 1, 0 (no ok submit), .5
    assert a.score == 1.0
    assert b.score == pytest.approx(0.5)
    assert r.score == pytest.approx(0.5 / 3)
    assert (a.wins, a.top2, b.wins, b.top2, r.wins, r.top2) == (3, 3, 1, 2, 0, 1)
    assert b.families == {"gym_box2d": 0.75, "mujoco": 0.0}
    assert r.is_reference


def test_an_entry_that_lacks_an_environment_is_not_ranked() -> None:
    scores = {
        "A": {"gym/acrobot": (1.0,), "gym/ant5": (1.0,)},
        "B": {"gym/acrobot": (9.0,)},
        "C": {"gym/acrobot": (0.0,), "gym/ant5": (None,)},
    }
    board = leaderboard(table(scores))
    assert [(row.entry, row.rank, row.score) for row in board.standings] == [("A", 1, 1.0), ("C", 2, 0.0)]
    (lacking,) = board.incomplete
    assert (lacking.entry, lacking.missing, lacking.n_environments) == ("B", ("gym/ant5",), 1)
    cell = board.cells["B", "gym/acrobot"]
    assert (cell.mean, cell.rank, cell.score) == (9.0, None, None)
    # It does not move the complete ones either.
    del scores["B"]
    assert leaderboard(table(scores)).standings == board.standings


def test_a_group_mean_needs_every_environment_of_the_group() -> None:
    found = normalised(
        table(
            {
                "A": {"gym/acrobot": (1.0,), "gym/ant5": (1.0,)},
                "B": {"gym/acrobot": (1.0,)},
                "C": {"gym/acrobot": (0.5,), "gym/ant5": (None,)},
                "R": {"gym/acrobot": (0.0,), "gym/ant5": (0.0,)},
            },
            reference="R",
        )
    )
    means = {group.entry: group.value for group in found.groups if group.demand == "tuning"}
    assert means == {"A": 1.0, "B": None, "C": None}


def test_repeats_give_their_mean() -> None:
    board = leaderboard(table({"A": {"gym/acrobot": (1.0, 2.0, 6.0)}, "B": {"gym/acrobot": (2.0, 2.5, 3.0)}}))
    assert board.cells["A", "gym/acrobot"].mean == 3.0
    assert (board.standings[0].entry, board.standings[0].rank) == ("A", 1)


def test_normalisation_clips_and_has_no_scale_where_nothing_beats_random() -> None:
    scale = scale_between(0.0, 10.0)
    assert scale is not None
    assert [scale.clipped(score) for score in (5.0, -5.0, 15.0)] == [0.5, 0.0, 1.0]
    assert {scale_between(*ends) for ends in ((2.0, 2.0), (3.0, 2.0), (None, 1.0), (0.0, None))} == {None}


def test_best_of_the_scale_is_an_agent_never_the_reference() -> None:
    result = normalised(table({"A": {"gym/ant5": (1.0,)}, "R": {"gym/ant5": (2.0,)}}, reference="R"))
    assert result.cells["A", "gym/ant5"] is None
    assert ("R", "gym/ant5") not in result.cells


def test_score_csv_with_a_wrong_cell_is_refused_with_its_line() -> None:
    with pytest.raises(ConfigError, match="line 2: 'fast'"):
        read_score_csv("entry,harness,gym/ant5\nA,x,fast\n")
    with pytest.raises(ConfigError, match="columns entry,harness"):
        read_score_csv("a,b\n")
    with pytest.raises(ConfigError, match="line 3"):
        read_score_csv("entry,harness,gym/ant5\nA,x,1\nA,x,2\n")


finite = st.integers(-5, 5).map(float)
single_runs = st.dictionaries(
    st.sampled_from("ABCDEF"),
    st.tuples(finite, finite, finite),
    min_size=2,
).map(lambda rows: {e: {env: (v,) for env, v in zip(ENVS, row, strict=True)} for e, row in rows.items()})


@given(single_runs, st.randoms(use_true_random=False))
def test_permuting_agents_permutes_rows(scores: dict, rng) -> None:
    names = sorted(scores)
    renamed = dict(zip(names, rng.sample(names, len(names)), strict=True))
    before = {row.entry: (row.score, row.rank, row.wins) for row in leaderboard(table(scores)).standings}
    permuted = table({renamed[name]: row for name, row in scores.items()})
    after = {row.entry: (row.score, row.rank, row.wins) for row in leaderboard(permuted).standings}
    assert after == {renamed[name]: row for name, row in before.items()}


@given(single_runs)
def test_monotone_transform_of_returns_changes_no_rank(scores: dict) -> None:
    warped = {e: {env: (math.exp(v) * 7 - 3,) for env, (v,) in row.items()} for e, row in scores.items()}
    assert leaderboard(table(scores)).standings == leaderboard(table(warped)).standings


@given(single_runs)
def test_dominated_newcomer_never_lowers_the_winner(scores: dict) -> None:
    best = leaderboard(table(scores)).standings[0]
    newcomer = {env: (min(row[env][0] for row in scores.values()) - 1.0,) for env in ENVS}
    after = {row.entry: row for row in leaderboard(table({**scores, "Z": newcomer})).standings}
    assert after[best.entry].score >= best.score - 1e-9
    assert after[best.entry].rank == 1
