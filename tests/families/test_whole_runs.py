"""An agent plays a whole run in each family of environments, through gateway, coordinator and worker, with videos where
the family renders: `evolve`, or `random` where spaces are of texts. One local cluster plays all runs of an agent."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import proofs
import pytest
from commands import Command, command, record_in, run_dir
from proofs import Proof

from evopolicy_worker.environments import describe, missing

pytestmark = [pytest.mark.families, pytest.mark.slow, pytest.mark.timeout(2500)]

BUDGET = 2


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> tuple[Path, Command]:
    """The folder of the runs of the chosen families, and the ended command."""
    folder = tmp_path_factory.mktemp("runs")
    items: list[Any] = [each for each in request.session.items if each.path == request.path]
    chosen = [each.callspec.params["proof"] for each in items]
    present = [each for each in chosen if not missing(each.env)]
    counts = ["--budget", str(BUDGET), "--validation", "1", "--heldout", "1", "--hidden-isolation", "off"]
    for agent in ("random", "evolve"):
        environments = [word for each in present if each.agent == agent for word in ("--env", each.env)]
        if not environments:
            continue
        more = ["--agent", agent, "--exp-id", "t", "--video", "all", "--parallel", "3"]
        with command(folder, "local", *environments, *counts, *more) as running:
            # Alone on two cores 200 s; beside other families several times as long.
            running.wait(2400)
        assert running.wait() == 0, running.err
    return folder, running


@pytest.mark.parametrize("proof", proofs.together(), ids=lambda proof: proof.family)
def test_an_agent_plays_a_whole_run(played: tuple[Path, Command], proof: Proof) -> None:
    proofs.demand(proof.env)
    root, done = played
    folder = run_dir(root, env=proof.env.replace("/", "_"))
    assert (folder / "run.json").is_file(), done.text[-4000:]
    outcome = record_in(folder).outcome
    assert outcome.status == "completed", done.text[-4000:]
    assert outcome.budget_used == BUDGET
    assert len(outcome.heldout_returns) == 1
    episodes = [each.parent for each in (folder / "workspace" / "feedback").rglob("trajectory.jsonl")]
    assert len(episodes) == BUDGET
    videos = [each for each in episodes if (each / "video.mp4").is_file()]
    assert len(videos) == (BUDGET if describe(proof.env).renders else 0)
    for each in videos:
        assert (each / "video.mp4").read_bytes()[4:8] == b"ftyp"
