"""A browser in a slot's jail: it plays in both sandboxed tiers, and is gone with its slot."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent

import pytest
from slots import Slots, family, pid_of, runs
from waiting import wait_until

from evopolicy_common.errors import WorkerError
from evopolicy_common.messages.episode import Tier

pytestmark = pytest.mark.families

SOLVER = """
    import numpy as np

    class Policy:
        def __init__(self, obs_space, action_space, env_meta):
            pass

        def reset(self, episode_index):
            pass

        def act(self, obs):
            button = next(each for each in obs["dom_elements"] if each["tag"] == "button")
            return {"action_type": 8, "coords": np.zeros(2, np.float32), "ref": button["ref"], "key": 0, "text": "", "field": 0}
"""  # noqa: E501


@pytest.fixture
def slots(tmp_path: Path) -> Iterator[Slots]:
    found = Slots(tmp_path)
    yield found
    found.close()


@pytest.mark.parametrize("tier", ["bwrap", "none"])
def test_a_policy_clicks_in_a_browser_in_its_slot(slots: Slots, tier: Tier) -> None:
    outcomes = slots.play_all(dedent(SOLVER), tier=tier, env="miniwob/click-test-v1", n=3)
    for outcome in outcomes:
        assert outcome.failure is None
        assert (outcome.length, outcome.terminated, outcome.success) == (1, True, True)
        assert outcome.episode_return > 0.9


def test_a_browser_that_played_a_hidden_episode_plays_no_train_episode(slots: Slots) -> None:
    """Attack: keeps something for a later episode: storage, cookies, databases, service workers, the
    window's name, the clipboard. Defence: storage lasts in memory for one episode; no secure context; a
    process whose browser has played a hidden episode plays no train episode."""
    slot = slots.new()
    slots.run(slot.start())

    def process_of(record: str) -> int:
        slots.play_all(None, slot=slot, env="miniwob/click-test-v1", record=record)
        return pid_of(slot)

    try:
        trained, hidden = process_of("full"), [process_of("actions") for _ in range(2)]
        assert hidden == [trained] * 2
        again = process_of("full")
        assert again != trained
        assert process_of("full") == again
    finally:
        slots.run(slot.close())


def test_a_tier_that_refuses_sockets_says_so(slots: Slots) -> None:
    with pytest.raises(WorkerError, match="tier bwrap"):
        slots.play_all(None, tier="landlock", env="miniwob/click-test-v1")


def test_a_closed_slot_leaves_no_browser(slots: Slots) -> None:
    slot = slots.new()
    slots.run(slot.start())
    slots.play_all(None, slot=slot, env="miniwob/click-test-v1")
    processes = family(pid_of(slot))
    names = [Path(f"/proc/{pid}/comm").read_text().strip() for pid in processes]
    assert [name for name in names if "chrom" in name]
    slots.run(slot.close())
    # The kernel ends the last of a jail a moment after its first process.
    wait_until(lambda: not [pid for pid in processes if runs(pid)])
    assert not list(slots.folder.glob("**/browser-*"))
