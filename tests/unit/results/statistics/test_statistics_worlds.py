"""Environments beside their worlds: the numbers against formulas, and a report with and without worlds."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from invented.policies import Version, policy
from invented.run_dirs import write_run

from evopolicy_common.catalogue import anchor
from evopolicy_common.catalogue.worlds import ids
from evopolicy_results.report import write_report
from evopolicy_results.statistics.intervals import mean, of_runs, stratified, stratum, stratum_of
from evopolicy_results.studies.study import study
from evopolicy_results.tables.report_tables import tables_of

ENVS = ("gym/acrobot", "gym/reacher5")


def test_two_strata_of_equal_size_have_welchs_interval() -> None:
    first, second = [1.0, 4.0, 2.5, 9.0], [0.5, 0.25, 0.75, -3.0]
    found = stratified([stratum_of(first), stratum_of(second)], [1.0, -1.0], "runs")
    expected = of_runs(first, second)
    assert (found.value, found.low, found.high) == pytest.approx(
        (expected.value, expected.low, expected.high)
    )


def test_one_stratum_of_runs_and_cases_has_the_crossed_interval() -> None:
    returns = np.random.default_rng(3).normal(size=(4, 12)) + np.arange(4)[:, None]
    found, expected = stratified([stratum(returns)], [1.0], "runs and cases"), mean(returns)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))


def test_intervals_over_worlds_cover_the_mean_of_all_worlds() -> None:
    generator, covered = np.random.default_rng(5), 0
    for _ in range(2000):
        worlds = generator.normal(0.4, 0.3, size=(4, 3))
        before = [stratum(generator.normal(0.9, 0.2, size=(1, 16))) for _ in range(4)]
        strata = before + [stratum_of(list(each)) for each in worlds]
        found = stratified(strata, [0.25] * 4 + [-0.25] * 4, "worlds, runs, and cases")
        covered += found.low <= 0.5 <= found.high
    assert 0.94 <= covered / 2000 <= 0.98


def written(runs: Path, entry: str, env: str, level: float) -> None:
    """A run whose held-out returns are about `level` on the known scale."""
    scale = anchor(env)
    generator = random.Random(f"{entry} {env}")
    value = scale.random.mean + level * scale.width
    returns = [value + generator.gauss(0.0, 0.01 * scale.width) for _ in range(16)]
    first = Version(policy(gain=1.0), returns[:8], value - 0.5 * scale.width)
    versions = [first, Version(policy(gain=2.0), returns[8:], value)]
    write_run(runs, versions, entry=entry, env=env, budget=16, heldout=returns, random_mean=scale.random.mean)


def test_a_report_pairs_environments_with_their_worlds(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    for env in ENVS:
        for entry, level in (("recites", 1.0), ("learns", 0.6)):
            written(runs, entry, env, level)
            for n, world in enumerate(ids(env)):
                written(runs, entry, world, 0.05 * n if entry == "recites" else level + 0.05 * (n - 1))
    found = study([runs])
    overall = {one.entry: one for one in found.worlds.paired if one.scope == ""}
    for entry, unchanged, worlds in (("recites", 1.0, 0.05), ("learns", 0.6, 0.6)):
        row = overall[entry]
        assert (row.n_environments, row.n_worlds) == (2, 6)
        assert row.unchanged.value == pytest.approx(unchanged, abs=0.02)
        assert row.worlds.value == pytest.approx(worlds, abs=0.02)
        low, high = row.difference.low, row.difference.high
        assert low < unchanged - worlds < high
        assert (low > 0.0) == (entry == "recites")
    curve = found.worlds.curves["learns"]
    levels = {point.episodes: (point.unchanged.value, point.worlds.value) for point in curve}
    assert levels[0] == levels[7] == (0.0, 0.0)
    assert levels[8] == pytest.approx((0.1, 0.1))
    assert levels[16] == pytest.approx((0.6, 0.6))
    page = write_report(found, tmp_path / "report", traces=False).read_text()
    assert 'id="worlds"' in page
    assert (tmp_path / "report" / "figures" / "worlds.svg").exists()


def test_a_report_without_worlds_has_no_part_about_them(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    written(runs, "learns", ENVS[0], 0.6)
    found = study([runs])
    assert found.worlds is None
    tables = {table.name: table for table in tables_of(found)}
    assert "worlds" not in tables
    (own, floor) = sorted(tables["cells"].rows, key=lambda row: -row["known"])
    assert own["known"] == pytest.approx(0.6, abs=0.02)
    assert floor["known"] == pytest.approx(0.0)
    assert 'id="worlds"' not in write_report(found, tmp_path / "report", traces=False).read_text()


def test_a_missing_score_in_a_world_leaves_its_environment_out(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    for env in ENVS:
        for each in (env, *ids(env)):
            written(runs, "learns", each, 0.5)
    broken = Version({"policy.py": "import nothing_like_this\n"}, (0.0,), None, "import_error")
    write_run(runs, [broken], entry="learns", env=ids(ENVS[0])[1], exp_id="again")
    found = study([runs], allow_mixed=True)
    rows = [(one.scope, one.n_environments) for one in found.worlds.paired if one.entry == "learns"]
    assert rows == [(ENVS[1], 1)]
