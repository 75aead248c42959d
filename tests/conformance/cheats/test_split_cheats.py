"""A policy that wants to know whether it is validated: what it can observe is the same in every split.

The policy tells what it sees through its actions, which is all that is kept of a hidden episode: 24 bits of a hash of
each fact. The operator reads them from the coordinator once the run is over.

Attacks, each with its defence:
- behaves differently during validation: it cannot distinguish splits: forty observable properties are equal
  in every split, or new in each episode.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from attacks.cheated import Cheated
from coordinator_harness import OperatorClient

from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.operator import EvaluationPage, RecordedRequest
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.episodes import rendered
from evopolicy_common.records.run_record import RunRecord, decode_run_record
from evopolicy_common.wire import credentials
from evopolicy_common.wire.transport import connect

POLICY = Path(__file__).with_name("programs") / "probing_policy.py"
N_CASES = 4
DIFFER = ("random numbers", "unseeded generator")
"""From episode to episode, in every split: no two episodes of a run share them."""
AGENT = """
import json, os, shutil, sys, urllib.request
shutil.copy(sys.argv[1], "system/policy.py")
body = json.dumps({"env_instances": [0, 1, 1, 2]}).encode()
urllib.request.urlopen(urllib.request.Request(os.environ["EVOPOLICYGYM_SUBMIT_URL"], data=body)).read()
"""


class Probed:
    """What the policy saw, by split: a list of facts an episode, in request order."""

    def __init__(self, cheated: Cheated, root: Path) -> None:
        agent = root / "probing_agent.py"
        agent.write_text(AGENT)
        policy = root / "policy.py"
        policy.write_text(POLICY.read_text())
        options = ["--jail-bind", str(policy), "--validation", str(N_CASES), "--heldout", str(N_CASES)]
        code, output, folder = cheated.play(f"command:{sys.executable} {agent} {policy}", "probed", *options)
        assert code == 0, output
        self.record: RunRecord = decode_run_record((folder / "run.json").read_bytes())
        feedback = folder / "workspace" / "feedback" / "submit_000" / "episodes" / "ep_000"
        self.names = (feedback / "stdout.txt").read_text().splitlines()
        found = credentials.read_credentials(Path(cheated.credentials["operator"]))
        splits: tuple[Split, ...] = ("train", "validation", "heldout")
        self.seen = {split: asyncio.run(self._facts(found, split)) for split in splits}

    async def _facts(self, found: credentials.Credentials, split: Split) -> list[dict[str, int]]:
        episodes: dict[int, dict[str, int]] = {}
        async with connect(found) as link:
            client = OperatorClient(link)
            cursor, finished = 0, False
            while not finished:
                message = RecordedRequest(
                    token=client.token, run=self.record.run, split=split, submit_index=0, cursor=cursor
                )
                page = await client.ask.until_answered("recorded", message, EvaluationPage)
                for outcome in page.outcomes:
                    ref = outcome.trajectory
                    assert ref is not None
                    assert outcome.failure is None, outcome.failure
                    data = ref.inline or await client.ask.download("operator", client.token, ref.digest)
                    assert digest_of(data) == ref.digest
                    episodes[outcome.index] = dict(zip(self.names, _words(data), strict=False))
                cursor, finished = page.cursor, page.finished
        assert len(episodes) == N_CASES
        return [episodes[index] for index in sorted(episodes)]


def _words(data: bytes) -> Iterator[int]:
    for row in rendered.decode(data).rows():
        action: Any = row.action
        yield round((float(action[0]) + 1) * 2**23)


@pytest.fixture(scope="module")
def probed(cheated: Cheated, tmp_path_factory: pytest.TempPathFactory) -> Probed:
    return Probed(cheated, tmp_path_factory.mktemp("probed"))


def test_the_probing_policy_sees_much_and_tells_all_of_it(probed: Probed) -> None:
    assert len(set(probed.names)) == len(probed.names) > 25
    for episodes in probed.seen.values():
        assert all(set(facts) == set(probed.names) for facts in episodes)


def test_a_policy_sees_the_same_in_train_validation_and_held_out(probed: Probed) -> None:
    fixed = [name for name in probed.names if name not in DIFFER]
    differences = {
        (split, index, name): (facts[name], train_facts[name])
        for split in ("validation", "heldout")
        for index, (facts, train_facts) in enumerate(
            zip(probed.seen[split], probed.seen["train"], strict=True)
        )
        for name in fixed
        if facts[name] != train_facts[name]
    }
    assert differences == {}


def test_what_differs_between_splits_differs_between_train_episodes_too(probed: Probed) -> None:
    for name in DIFFER:
        values = [facts[name] for episodes in probed.seen.values() for facts in episodes]
        assert len(set(values)) == len(values), name


def test_the_comparison_would_see_a_policy_that_is_told_its_split(probed: Probed) -> None:
    marked = [{**facts, "environment variables": 7} for facts in probed.seen["validation"]]
    assert marked != probed.seen["train"]
    assert [facts["episode index"] for facts in probed.seen["train"]] == [
        facts["episode index"] for facts in probed.seen["heldout"]
    ]
    assert len({facts["episode index"] for facts in probed.seen["train"]}) == N_CASES


def test_the_probing_run_is_scored_as_any_other(probed: Probed) -> None:
    assert probed.record.outcome.status == "completed"
    assert probed.record.outcome.budget_used == N_CASES
    assert len(probed.record.outcome.heldout_returns) == N_CASES
