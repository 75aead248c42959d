"""Slots that play environments of anyone's: what a hidden episode taught them reaches no train episode, and what they
break is told."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from slots import Slots, acting, category_of, failure_of, going_on, make_job, prefix, rows
from waiting import wait_until

from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import SlotDiedError, WorkerError
from evopolicy_worker.environments.browser.page import Page
from evopolicy_worker.environments.families.foreign import ForeignFamily
from evopolicy_worker.environments.interface import calls
from evopolicy_worker.environments.interface.calls import (
    USUAL,
    EnvironmentLimits,
    LimitGuard,
    RunningCall,
    hung,
)
from evopolicy_worker.slot_protocol.endings import AGAIN
from evopolicy_worker.slots import slot as slot_module
from evopolicy_worker.slots.slot import Slot

pytestmark = pytest.mark.slow

OFTEN = ("nan", "raise in reset, later", "custom space", "exit", "hang", "raise in reset", "leak")
"""Faults that `make test` plays; the others start as many processes, and are played in the system's layer."""


def faults(names: Iterable[str]) -> list[Any]:
    return [pytest.param(name, marks=() if name in OFTEN else pytest.mark.system) for name in names]


PACKAGE = Path(__file__).parents[3] / "support" / "foreign_package"


@pytest.fixture
def slots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Slots]:
    monkeypatch.setenv("PYTHONPATH", str(PACKAGE))
    found = Slots(tmp_path)
    yield found
    found.close()


def slot_of(slots: Slots, name: str, limits: EnvironmentLimits = USUAL, **more: Any) -> Slot:
    entry = Entry(id=f"acme/{name}", gymnasium_id=f"acme_envs:{name}-v0", **more)
    return Slot(None, "bwrap", slots.folder / f"of-{name}", definitions=(entry,), limits=limits)


def returned(slots: Slots, slot: Slot, record: str) -> float:
    (outcome,) = slots.play_all(None, slot=slot, env="acme/Keeper", record=record)
    return outcome.episode_return


def test_a_process_that_has_played_a_hidden_episode_plays_no_train_episode(slots: Slots) -> None:
    """Attack: comes with the user (`--env my_pkg:MyEnv-v0`), remembers a hidden episode in memory or in a
    file, and lets it determine rewards of train episodes. Defence: a process that has played part of a
    hidden episode of such an environment plays no train episode; its folders are emptied."""
    with slots.running(slot_of(slots, "Keeper")) as slot:
        assert [returned(slots, slot, "full") for _ in range(2)] == [1.0, 2.0]
        assert [returned(slots, slot, "actions") for _ in range(2)] == [3.0, 4.0]
        assert returned(slots, slot, "full") == 1.0


def test_a_process_replaced_in_a_hidden_episode_plays_no_train_episode(slots: Slots) -> None:
    """Attack: comes with the user (`--env my_pkg:MyEnv-v0`), remembers a hidden episode in memory or in a
    file, and lets it determine rewards of train episodes. Defence: a process that has played part of a
    hidden episode of such an environment plays no train episode; its folders are emptied."""
    with slots.running(slot_of(slots, "Keeper", kwargs={"dies_of": 0.89})) as slot:
        # The policy's action ends the first process; random actions, which are smaller, play the episode again.
        (outcome,) = slots.play_all(PUSHES, slot=slot, env="acme/Keeper", record="actions")
        assert category_of(outcome) == "killed"
        assert outcome.episode_return == 1.0
        assert returned(slots, slot, "full") == 1.0


@pytest.mark.parametrize("how", ["raise in close", "leave when pushed"])
def test_an_environment_that_cannot_be_closed_plays_again(slots: Slots, how: str) -> None:
    with slots.running(slot_of(slots, "Bad", kwargs={"how": how})) as slot:
        (outcome,) = slots.play_all(PUSHES, slot=slot, env="acme/Bad", record="actions")
        assert (failure_of(outcome).category, outcome.length) == ("killed", 8)


def test_pages_with_own_options_have_browser_and_fonts_fingerprinted(monkeypatch: pytest.MonkeyPatch) -> None:
    versions = {"chromium": "1.2", "fonts": "f"}
    monkeypatch.setattr(Page, "identity", lambda self: versions)
    name = "evopolicy_worker.environments.browser.registered:evopolicy/MiniWoB-v0"
    entry = Entry(id="my/page", gymnasium_id=name)
    packages = ForeignFamily(entry).packages(entry)
    assert versions.items() <= packages.items()


def test_success_is_decided_by_the_last_step_or_by_any(slots: Slots) -> None:
    with slots.running(slot_of(slots, "Treasure", success="is_success")) as slot:
        (outcome,) = slots.play_all(None, slot=slot, env="acme/Treasure")
        assert outcome.success is outcome.terminated
        assert set(outcome.reward_components) == {"reward_0", "reward_1"}
        assert outcome.episode_return == pytest.approx(sum(outcome.reward_components.values()))
    (line,) = slots.play_all(None, env="toy/line")
    assert line.success is None
    with slots.running(slot_of(slots, "Bad", kwargs={"how": "success in an array"}, success="near")) as slot:
        assert slots.play_all(None, slot=slot, env="acme/Bad")[0].success is False


@pytest.mark.parametrize("env", ["gymnasium/FetchPush-v4", "gymnasium/parking-v0"])
def test_success_of_hidden_episodes_is_recorded_where_the_definition_names_none(
    slots: Slots, env: str
) -> None:
    hidden = slots.play_all(None, env=env, n=2, record="actions")
    assert [type(outcome.success) for outcome in hidden] == [bool, bool]
    (train,) = slots.play_all(None, env=env, record="full")
    assert train.success is None  # an agent's feedback is as it was


REFUSED = {
    "nan": "environment acme/Bad, step 0, reward: it is nan",
    "outside": "environment acme/Bad, step 0, observation: element",
    "raise in reset": "environment acme/Bad, reset: it raised RuntimeError",
    "change spaces": "environment acme/Bad, reset, observation_space: it has changed",
    "no bounds": "environment acme/Bad, action_space",
    "custom space": "environment acme/Bad, observation_space: a space of type Opaque",
    "exit": "environment acme/Bad: its process ended while it was tried out",
    "leave": "environment acme/Bad, step 0: it raised SystemExit: no more levels; it has to take any action",
    "interrupt": "environment acme/Bad, step 0: it raised KeyboardInterrupt",
    "raise in reset, later": "environment acme/Bad, reset: it raised RuntimeError: no level of that seed",
    "hang": "environment acme/Bad, step 0: it has not returned for 8 s",
    "hang in make": "environment acme/Bad, make: it has not returned for 8 s",
    "hang in close": "environment acme/Bad, close: it has not returned for 8 s",
    "hold": "environment acme/Bad, make, reset or step: it has not returned for 8 s",
}
"""A slot's error for an environment that is tried out."""


@pytest.mark.parametrize("how", faults(REFUSED))
def test_an_environment_that_breaks_its_description_is_refused(
    slots: Slots, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slot_module, "SILENT_S", 16.0)
    why = REFUSED[how]
    how, later, _ = how.partition(", later")
    # After the trial, steps are timed in episodes of other seeds.
    kwargs = {"how": how, "seeds_from": 2 if later else 0}
    with (
        slots.running(slot_of(slots, "Bad", EnvironmentLimits(call_s=8.0), kwargs=kwargs)) as slot,
        pytest.raises((WorkerError, SlotDiedError), match=why),
    ):
        slots.run(slot.describe(["acme/Bad"]))
    assert slots.play(None, env="toy/line").length > 0


WRONG = {
    "nan": "environment acme/Bad, step 0, reward: it is nan; rewards have to be finite",
    "shape": (
        r"environment acme/Bad, step 0, observation: an array of shape \(3,\), not \(2,\); correct the environment"
    ),
    "raise in reset": (
        "environment acme/Bad, reset: it raised RuntimeError: no level of that seed; correct the environment"
    ),
    "change spaces": "environment acme/Bad, reset, observation_space: it has changed; a space has to stay",
    "error": "environment acme/Bad, step 0: it raised FileNotFoundError: levels.dat; correct the environment",
    "exit": "environment acme/Bad: its process ended while it played; the slot's process ended with status 3",
    "leave": "environment acme/Bad, step 0: it raised SystemExit: no more levels; correct the environment",
    "interrupt": "environment acme/Bad, step 0: it raised KeyboardInterrupt: ; correct the environment",
    "huge": "environment acme/Bad, reward: its sum over 8 steps is [78].*e.200; rewards, .* have to be finite",
    "component": "environment acme/Bad, fuel: its sum over 8 steps is nan; rewards, their components, .* finite",
    "close files": "environment acme/Bad",
    "object reward": (
        r"environment acme/Bad, step 0, reward: it is <object .* \(object\); a reward has to be one number"
    ),
    "hang": "environment acme/Bad, step 0: it has not returned for 8 s, the limit of one call; .*--env-timeout",
    "hang in reset": "environment acme/Bad, reset: it has not returned for 8 s",
    "hang in make": "environment acme/Bad, make: it has not returned for 8 s",
    "hold": "environment acme/Bad, reset or step: it has not returned for 8 s",
    "gorge": "environment acme/Bad, step 0: there is no memory left for it; .*--env-memory",
    "leak": "environment acme/Bad.* memory.*--env-memory",
    "custom space": "environment acme/Bad, observation_space: a space of type Opaque",
}
"""A slot's error for an episode that an environment prevents."""
POLICY = acting("return [{action}]")
PUSHES = POLICY.format(action=0.9)
LUCKY = """
import time
class Policy:
    def __init__(self, *spaces): self.n = 0
    def reset(self, episode_index): pass
    def act(self, obs):
        self.n += 1
        return [0.9 if self.n == 6 else (time.time_ns() // 1000 % 1_000_000) / 2e6]
"""
"""Throws by the clock, then pushes."""


@pytest.mark.parametrize("how", faults(WRONG))
def test_what_prevents_an_episode_is_reported_by_name_and_is_nobodys_result(
    slots: Slots, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(slot_module, "_CHECK_S", 0.5)
    monkeypatch.setattr(slot_module, "SILENT_S", 16.0)
    # Long enough for calls that return, also on a busy machine.
    limits, again = EnvironmentLimits(memory_bytes=320 << 20) if how == "leak" else USUAL, {}
    if how.startswith(("hang", "hold")):
        limits, again = EnvironmentLimits(call_s=8.0), {"environment_faults": AGAIN}
    fuel = {"reward_components": {"fuel": "spent"}}
    with slots.running(slot_of(slots, "Bad", limits, kwargs={"how": how}, **fuel)) as slot:
        # Also where the policy's actions come first, and random ones play the episode again.
        with pytest.raises(WorkerError, match=WRONG[how]):
            slots.play_all(PUSHES, slot=slot, env="acme/Bad", n=20 if how == "leak" else 1, **again)
        slots.run(slot.start())
        assert slots.play_all(None, slot=slot, env="toy/line")[0].length > 0


@pytest.mark.parametrize("how", faults(["hold", "hang"]))
def test_an_environment_that_hangs_on_actions_gives_no_second_throw(
    slots: Slots, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attack: makes an environment hang on its actions in hidden episodes, also where it holds Python's
    interpreter, for a second attempt or a run that never ends. Defence: its actions are in a file of
    the slot, and the next attempt plays them; in the fourth one the hang is its failure."""
    monkeypatch.setattr(slot_module, "_CHECK_S", 0.5)
    monkeypatch.setattr(slot_module, "SILENT_S", 16.0)
    slot = slot_of(slots, "Bad", EnvironmentLimits(call_s=8.0), kwargs={"how": f"{how} when pushed"})
    bundle = slots.bundle(LUCKY)
    job = make_job(env="acme/Bad", record="actions")
    stands: list[list[float]] = []
    try:
        for _ in range(2):
            slots.run(slot.start())
            with pytest.raises(WorkerError, match=r"environment acme/Bad, .*step.*: it has not returned"):
                slots.run(slot.play_job(job, bundle, lambda *progress: None))
            job = going_on(job, slot)
            stands.append(prefix(job))
        # The clock gave the policy no second throw.
        assert len(stands[0]) == 6
        assert stands[0] == stands[1]
        slots.run(slot.start())
        job = msgspec.structs.replace(job, environment_faults=AGAIN)
        (outcome,) = slots.run(slot.play_job(job, bundle, lambda *progress: None))
        assert (failure_of(outcome).category, outcome.length) == ("killed", 8)
    finally:
        slots.run(slot.close())


def test_a_close_that_hangs_ends_the_process_at_the_next_episode(slots: Slots) -> None:
    with slots.running(
        slot_of(slots, "Bad", EnvironmentLimits(call_s=8.0), kwargs={"how": "hang in close"})
    ) as slot:
        assert slots.play_all(PUSHES, slot=slot, env="acme/Bad")[0].length == 8
        with pytest.raises(WorkerError, match="environment acme/Bad, close: it has not returned for 8 s"):
            slots.play_all(PUSHES, slot=slot, env="acme/Bad")
        slots.run(slot.start())
        assert slots.play_all(PUSHES, slot=slot, env="acme/Bad")[0].length == 8


def test_observations_beyond_bounds_are_played_and_the_operator_told(slots: Slots) -> None:
    with slots.running(slot_of(slots, "Bad", kwargs={"how": "outside"})) as slot:
        (outcome,) = slots.play_all(PUSHES, slot=slot, env="acme/Bad")
        assert (outcome.length, outcome.failure) == (8, None)
        told = "environment acme/Bad, step 0, observation: element"
        wait_until(lambda: any(told in each for each in slot._stderr))


@pytest.mark.parametrize("how", ["fork", "fork and wait"])
def test_forks_of_an_environment_play_no_part(slots: Slots, how: str) -> None:
    with slots.running(slot_of(slots, "Bad", kwargs={"how": how})) as slot:
        for _ in range(2):
            (outcome,) = slots.play_all(PUSHES, slot=slot, env="acme/Bad")
            assert (outcome.length, outcome.failure) == (8, None)
            assert len(rows(outcome)) == 8


def test_memory_is_looked_at_from_outside_the_call(monkeypatch: pytest.MonkeyPatch) -> None:
    guard = LimitGuard(EnvironmentLimits(memory_bytes=64 << 20))
    monkeypatch.setattr(calls, "resident_bytes", lambda: 65 << 20)
    monkeypatch.setattr(calls, "current", RunningCall())
    calls.current.begin("my/env", "reset")
    assert (
        guard.check(1000.0)
        == "environment my/env, reset: its process has 65 MiB of memory, and 64 MiB are the limit; mend what it keeps"
        " from episode to episode, or raise the worker's --env-memory"
    )


def test_only_a_calls_running_time_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    guard = LimitGuard(EnvironmentLimits(call_s=5.0))
    monkeypatch.setattr(calls, "current", RunningCall())
    call = calls.current
    call.begin("my/env", "reset")
    assert [guard.check(now) for now in (0.0, 100.0, 200.0, 300.0)] == [""] * 4
    call.done()
    for now in range(301, 320):
        call.what, call.step = "step", now
        assert guard.check(float(now)) == ""
    call.step = 7
    told = [guard.check(400.0 + k / 2) for k in range(14)]
    assert told.index(hung("environment my/env, step 7", 5.0)) > 10


@pytest.mark.parametrize("how", ["print", "threads", "close stdout"])
def test_printing_and_threads_harm_nobody(slots: Slots, how: str) -> None:
    with slots.running(slot_of(slots, "Bad", kwargs={"how": how})) as slot:
        for _ in range(2):
            (outcome,) = slots.play_all(None, slot=slot, env="acme/Bad")
            assert outcome.length == 8


BROWSES = """
class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        assert obs_space["spaces"]["page"]["type"] == "Dict"
        assert action_space["spaces"][0]["spaces"]["links"]["type"] == "Sequence"
    def reset(self, episode_index): pass
    def act(self, obs):
        assert obs["page"]["title"] in ("start", "goal")
        return ({"title": obs["page"]["links"][0], "links": ()}, 1)
"""


def test_opaque_objects_are_encoded_by_their_family_both_ways(slots: Slots) -> None:
    with slots.running(slot_of(slots, "Browser")) as slot:
        (description,) = slots.run(slot.describe(["acme/Browser"]))
        assert "page.title" in description.task_text
        (outcome,) = slots.play_all(BROWSES, slot=slot, env="acme/Browser")
        assert (outcome.failure, outcome.episode_return) == (None, 5.0)
        assert rows(outcome)[1].obs["page"] == {"title": "goal", "links": ("goal", "start")}
        (random,) = slots.play_all(None, slot=slot, env="acme/Browser")
        assert random.length == 5
