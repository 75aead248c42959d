"""Environments in the published profile: what policies are told and may return, and where observations are, as
`published/published_minigrid.json` has them."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from slots import Slots

from evopolicy_common import published_forms
from evopolicy_common.records.episodes import rendered
from evopolicy_gateway.submits.episode_files import as_published
from evopolicy_worker import environments

GOLDEN: dict[str, Any] = json.loads(
    (Path(__file__).parent / "published" / "published_minigrid.json").read_text()
)
TELLER = """
import json
import numpy as np

class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        print(json.dumps([obs_space, action_space, env_meta]))
        self.answers = [%s]

    def reset(self, episode_index):
        self.n = 0

    def act(self, obs):
        assert type(obs["image"]) is list and type(obs["mission"]) is str
        self.n += 1
        return self.answers[(self.n - 1) %% len(self.answers)]
"""


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Slots]:
    slots = Slots(tmp_path_factory.mktemp("published"))
    yield slots
    slots.close()


def without_repr(space: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in space.items() if name != "repr"}


def check_told(told: dict[str, Any]) -> None:
    spaces = told["obs_space"]["spaces"]
    assert {name: without_repr(space) for name, space in spaces.items()} == GOLDEN["spaces"]
    assert type(spaces["mission"]["repr"]) is str
    assert told["obs_storage"] == GOLDEN["env_meta"]["obs_storage"]
    assert list(told["reward_components"]) == GOLDEN["env_meta"]["reward_components"]


@pytest.mark.parametrize("env", GOLDEN["environments"])
def test_minigrid_is_described_as_in_the_published_software(env: str) -> None:
    description = environments.describe(env)
    spaces = description.obs_space, description.action_space
    told = published_forms.described(*spaces, description.obs_storage)
    check_told(told)
    assert told["artifacts"]
    assert told["action_space"] == description.action_space


def test_policies_are_told_the_published_spaces_and_actions_are_read_so(played: Slots) -> None:
    answers, wanted = list(GOLDEN["actions"]), list(GOLDEN["actions"].values())
    options: dict[str, Any] = {"observations": "lists", "render": True, "max_steps": 40, "published": True}
    policy = TELLER % ", ".join(answers)
    outcome = played.play(policy, env=GOLDEN["environments"][0], policy_scope="submit", **options)
    assert outcome.failure is None
    obs_space, action_space, told = json.loads(outcome.stdout.splitlines()[0])
    check_told(told)
    assert (obs_space, action_space) == (told["obs_space"], told["action_space"])
    assert "artifacts" not in told
    assert outcome.trajectory is not None
    assert outcome.trajectory.inline is not None
    files = as_published(
        rendered.checked_files(outcome.trajectory.inline, outcome.length, outcome.episode_return)
    )
    rows = [json.loads(line) for line in files["trajectory.jsonl"].splitlines()]
    marks = [bool(row["info"].get("action_invalid")) for row in rows]
    assert marks == [wanted[t % len(wanted)][1] for t in range(len(rows))]
    observations = GOLDEN["observations"]
    assert {row["obs"] for row in rows} == {observations["row"]}
    arrays = np.load(io.BytesIO(files[observations["file"]]))
    assert sorted(arrays) == observations["arrays"]
    assert arrays["mission"].dtype.kind == observations["mission_kind"]
    assert arrays["image"].shape == (len(rows), 7, 7, 3)
    assert arrays["image"].dtype == np.uint8
    as_whole = played.play(
        TELLER % ", ".join(str(action) for action, _ in wanted),
        env=GOLDEN["environments"][0],
        policy_scope="submit",
        **options,
    )
    assert (as_whole.episode_return, as_whole.length) == (outcome.episode_return, outcome.length)
