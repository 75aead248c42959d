"""Everything that crossed to a gateway in a whole run, its memory, its logs and the workspace hold no hidden seed and
no hidden return, in any form; and a leak that is planted is found in each of these places."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
from attacks.golden_run import EPISODES, N_CASES, N_SUBMITS, GoldenCluster, GoldenRun
from attacks.leak_search import Needles

from evopolicy_common.records.run_record import decode_run_record
from evopolicy_common.wire import codec

pytestmark = [pytest.mark.system, pytest.mark.slow]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GoldenCluster]:
    # Hidden episodes are played while the agent's side is open, as they would be on machines without agents.
    cluster = GoldenCluster(tmp_path_factory.mktemp("golden"), "--hidden-isolation", "off")
    try:
        yield cluster
    finally:
        cluster.close()


@pytest.fixture(scope="module")
def golden(cluster: GoldenCluster) -> GoldenRun:
    return GoldenRun(cluster, "honest")


@pytest.fixture(scope="module")
def leaky(cluster: GoldenCluster, golden: GoldenRun) -> Iterator[GoldenRun]:
    """A run whose coordinator tells its gateway the hidden seeds and all returns."""
    hidden = [case.seed for split in ("valid", "heldout") for case in cluster.cases[split]]
    cluster.leak.write_text(json.dumps(hidden))
    try:
        yield GoldenRun(cluster, "leaky")
    finally:
        cluster.leak.unlink()


def hidden_of(run: GoldenRun) -> Needles:
    """All that a gateway must not learn: every seed, those of the train cases too, and all that hidden episodes came
    to."""
    needles = Needles()
    for split, cases in run.cluster.cases.items():
        for number, case in enumerate(cases):
            needles.add_seed(f"seed of {split} {number}", case.seed)
            needles.add_text(f"mark of {split} {number}", case.mark)
    for what, outcomes in run.outcomes.items():
        assert len(outcomes) == 2
        for outcome in outcomes:
            name = f"{what} {outcome.index}"
            needles.add_number(f"return of {name}", outcome.episode_return)
            for component, value in outcome.reward_components.items():
                needles.add_number(f"{component} of {name}", value)
            assert outcome.trajectory is not None
            needles.add_text(f"actions of {name}", outcome.trajectory.digest)
    for index, mean in run.finished.val_scores.items():
        needles.add_number(f"validation mean of submit {index}", mean)
    assert run.finished.final_score is not None
    needles.add_number("score", run.finished.final_score)
    return needles


def visible_of(run: GoldenRun) -> Needles:
    """The train returns, which a gateway is told: a search that does not find them finds nothing."""
    needles = Needles()
    for number in range(N_SUBMITS):
        summary = run.workspace / "feedback" / f"submit_{number:03d}" / "summary.json"
        for index, value in enumerate(json.loads(summary.read_bytes())["returns"]):
            needles.add_number(f"train return {number}.{index}", value)
    return needles


def seeds_of(run: GoldenRun) -> set[str]:
    return {f"seed of {split} {number}" for split in ("valid", "heldout") for number in range(N_CASES[split])}


def test_nothing_hidden_crosses_to_the_gateway(golden: GoldenRun) -> None:
    hidden, visible = hidden_of(golden), visible_of(golden)
    wire = bytes(golden.wiretap.heard) + bytes(golden.wiretap.sent)
    assert hidden.found_in(wire) == set()
    assert visible.found_in(wire) == visible.names
    for _, key, payload in golden.cluster.crossed(f"/gw/{golden.run}/"):
        assert hidden.found_in(payload) == set(), key


def test_the_wiretap_has_heard_what_the_coordinator_says_that_it_answered(golden: GoldenRun) -> None:
    crossed = golden.cluster.crossed(f"/gw/{golden.run}/")
    verbs = {key.rpartition("/")[2] for _, key, _ in crossed}
    assert {"open", "submit", "results", "blob", "close"} <= verbs
    kept = {"answer": bytes(golden.wiretap.heard), "question": bytes(golden.wiretap.sent)}
    for way, key, payload in crossed:
        # What the gateway asked when it was let go again comes over a link that has been made anew, or not at all.
        if not key.endswith("/close"):
            assert payload in kept[way] or len(payload) > 30_000, key


def test_no_answer_to_a_gateway_holds_more_than_its_fields(golden: GoldenRun) -> None:
    for way, key, payload in golden.cluster.crossed(f"/gw/{golden.run}/"):
        if way == "answer":
            assert codec.encode(codec.decode(codec.gateway_replies, payload)) == payload, key


@pytest.mark.parametrize(
    "place",
    ["supervisor beside the agent", "gateway beside the agent", "gateway, after the scoring"],
)
def test_nothing_hidden_is_in_the_memory_of_the_agents_side(golden: GoldenRun, place: str) -> None:
    hidden, visible = hidden_of(golden), visible_of(golden)
    found = [hidden.found_in(region, short=False) for region in golden.memory[place]]
    assert set().union(*found) == set()
    if place.startswith("gateway"):
        seen = [visible.found_in(region, short=False) for region in golden.memory[place]]
        assert set().union(*seen), "the gateway's memory does not even hold the train returns"


def test_workspace_and_logs_hold_nothing_hidden_while_the_run_is_scored(golden: GoldenRun) -> None:
    hidden = hidden_of(golden)
    assert {"logs/harness.log", "logs/agent.jsonl", "workspace/AGENTS.md"} <= set(golden.found_early)
    for path, data in golden.found_early.items():
        assert hidden.found_in(data) == set(), path


def test_hidden_returns_are_written_only_when_gateway_and_agent_are_gone(golden: GoldenRun) -> None:
    hidden = hidden_of(golden)
    assert not golden.record_came_early
    assert not golden.supervisor_outlived_the_run
    assert golden.gateway_is_gone
    record = (golden.folder / "run.json").read_bytes()
    assert {f"return of held-out {index}" for index in range(2)} <= hidden.found_in(record)
    files = golden.read_files()
    # Both are the operator's, written at the end.
    for content in (record, files.pop("logs/env.log", b"")):
        assert not any(name.startswith(("seed", "mark")) for name in hidden.found_in(content))
    for path, data in files.items():
        assert hidden.found_in(data) == set(), path
    assert decode_run_record(record).outcome.budget_used == N_SUBMITS * len(EPISODES)


def test_the_search_finds_the_seeds_and_returns_where_they_do_cross(golden: GoldenRun) -> None:
    hidden = hidden_of(golden)
    tap = golden.cluster.worker_tap
    found = hidden.found_in(bytes(tap.heard) + bytes(tap.sent))
    assert seeds_of(golden) <= found
    assert {name for name in hidden.names if name.startswith(("return", "mark of valid"))} <= found


def test_a_planted_leak_is_found_in_traffic_memory_and_workspace(leaky: GoldenRun) -> None:
    hidden = hidden_of(leaky)
    wanted = seeds_of(leaky)
    assert wanted <= hidden.found_in(bytes(leaky.wiretap.heard))
    tapped = [hidden.found_in(payload) for _, _, payload in leaky.cluster.crossed(f"/gw/{leaky.run}/")]
    assert wanted <= set().union(*tapped)
    assert wanted <= set().union(*(hidden.found_in(data) for data in leaky.found_early.values()))
    memory = leaky.memory["gateway beside the agent"]
    # The task's text is kept for as long as the gateway lives; what else it was told may be overwritten by now.
    assert seeds_of(leaky) <= set().union(*(hidden.found_in(region, short=False) for region in memory))
