"""Each family of environments lives: a policy of ours beats random on cases fixed beforehand, and `check-env` finds
nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import proofs
import pytest
from proofs import Proof
from slots import Slots, make_job

from evopolicy_common import catalogue
from evopolicy_common.messages.episode import ResourceLimits
from evopolicy_common.statistics.intervals import over_cases
from evopolicy_worker import check_env

pytestmark = pytest.mark.families

TABLE = proofs.table()
each_family = pytest.mark.parametrize("proof", proofs.together(), ids=lambda proof: proof.family)
ROLES = {"core16", "core16-worlds", "toy", "breadth", "paper13"}
"""Suites that are no family."""


@pytest.fixture(autouse=True)
def _installed(request: pytest.FixtureRequest) -> None:
    proof = request.node.callspec.params["proof"] if hasattr(request.node, "callspec") else None
    if proof is not None:
        proofs.demand(proof.env)


def test_every_family_has_a_row_and_cases_that_nobody_chose() -> None:
    assert {each.family for each in TABLE} == catalogue.suites().keys() - ROLES, proofs.FOLDER / "table.toml"
    # Were the formula changed, somebody could have chosen them.
    assert proofs.drawn("toy_text")[:3] == [1669681935, 1894838440, 331552000]
    for proof in TABLE:
        suite = catalogue.suites()[proof.family]
        assert {proof.env, *proof.check} <= set(suite.environments)
        assert len(set(proof.seeds)) == proof.cases >= 6


@pytest.mark.slow
@pytest.mark.timeout(600)
@each_family
def test_a_policy_beats_random_on_the_cases_that_were_fixed_beforehand(slots: Slots, proof: Proof) -> None:
    def returns(folder: Path | None) -> Any:
        found = []
        for seed in proof.seeds:
            job = make_job(
                env=proof.env,
                seed=seed,
                bundle=None if folder is None else "digest",
                limits=ResourceLimits(),
                max_steps=proof.steps,
                record="actions",
            )
            (outcome,) = slots.run(slots.slot().play_job(job, folder, lambda episodes, steps: None))
            assert outcome.failure is None, outcome.failure
            found.append(outcome.episode_return)
        return np.array(found)

    ours, random = returns(proof.policy), returns(None)
    better = over_cases(ours - random, (ours, random))
    command = (
        f"{proof.env}: {ours.mean():.4g} beside {random.mean():.4g}, better by {better.low} to {better.high}"
    )
    print(command)
    # Without any spread there is no interval: the difference is the same on every case.
    least = better.value if better.low is None else better.low
    assert least > 0, command


@pytest.mark.slow
@pytest.mark.timeout(600)
@each_family
def test_check_env_finds_nothing_in_a_few_environments_of_the_family(proof: Proof) -> None:
    verdicts = {each.here.env: each.verdict for each in check_env.check(proof.check, (), proof.check_steps)}
    assert verdicts == dict.fromkeys(proof.check, "ok")
