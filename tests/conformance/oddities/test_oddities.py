"""Oddities of other people's environments: each is played as an honest one is, or refused with its remedy.

A policy plays each, and the recording is played again: it has the actions that were sent, and repeats bit for bit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from slots import Slots, acting, make_job, rows

from evopolicy_common.catalogue import Entry
from evopolicy_common.errors import WorkerError
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.records.episodes.rendered import OBSERVATIONS, ROWS, checked_files
from evopolicy_common.records.episodes.trajectory import Recorder, Row
from evopolicy_worker.environments.interface import calls
from evopolicy_worker.environments.interface.calls import USUAL, EnvironmentLimits
from evopolicy_worker.slot_protocol.begun import PackedBegun, pack
from evopolicy_worker.slots.slot import Slot

pytestmark = pytest.mark.slow

N = 12
"""Steps of each episode."""
SENT = [round(0.08 * t - 0.4, 2) for t in range(N)]
"""Actions of the policy."""
PUSH = f"self.t += 1; return np.array([{SENT}[self.t - 1]], np.float32)"
BOTH = f"self.t += 1; return {{'push': np.array([{SENT}[self.t - 1]], np.float32), 'turn': np.array([3, self.t % 4])}}"


@dataclasses.dataclass(frozen=True)
class Odd:
    """An environment of `package/oddities.py` that is played."""

    name: str
    definition: dict[str, Any] = dataclasses.field(default_factory=dict)
    """Fields of its file."""
    act: str = PUSH
    rewards: list[float] | None = None
    infos: dict[str, Any] | None = None
    """Parts of the info of the third step."""

    @property
    def entry(self) -> Entry:
        name = f"{self.name}-{'-'.join(self.definition)}".rstrip("-")
        return Entry(id=f"odd/{name}", gymnasium_id=f"oddities:{self.name}-v0", **self.definition)


PLAYED = [
    Odd("Plain", rewards=SENT),
    Odd("ChangesItsAction", rewards=[each / 2 for each in SENT]),
    Odd("KeepsItsAction", rewards=SENT),
    Odd("ChangesPartsOfItsAction", act=BOTH, rewards=[each / 2 for each in SENT]),
    Odd(
        "ReusesWhatItReturns",
        rewards=[1.0 + t for t in range(N)],
        infos={"n": [3.0, 3.0], "deep": {"n": 3}, "listed": [3]},
    ),
    Odd("ActionIsItsObservation", infos={"last": [pytest.approx(SENT[2])]}),
    Odd(
        "SaysOurMarks",
        infos={"steps": 3, "environment.steps": 77, "environment.policy_failed": True, "fuel": 3},
    ),
    Odd("NeedsOptions", {"reset_options": {"levels": [1, 2]}}),
    Odd("ChangesItsArguments", {"kwargs": {"levels": [1, 2]}}),
    Odd("Unseeded", {"deterministic": False}),
    Odd("TellsTheTime", {"deterministic": False}, rewards=SENT),
    Odd("Noise", rewards=[1.0] * N),
]


VARIES = Odd("Plain", {"deterministic": False})
AGAIN = r"another one when seed 0 and the same actions are played again; draw from self.np_random"
REFUSED = {
    "Unseeded": rf"odd/Unseeded, step 0, reward: it is {AGAIN} .*or say deterministic = false",
    "UnseededAtTheStart": rf"odd/UnseededAtTheStart, reset, observation: it is {AGAIN}",
    "TellsTheTime": rf"odd/TellsTheTime, step 0, info\['clock'\]: it is {AGAIN}",
    "NeedsOptions": r"odd/NeedsOptions, reset: it raised AssertionError",
    "WaitsForAChild": (
        r"odd/WaitsForAChild, close: it has not returned for 8 s.*child processes ignore SIGTERM here: end them with"
    ),
}


@pytest.fixture(scope="module")
def slots(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Slots]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent / "package"))
        found = Slots(tmp_path_factory.mktemp("odd"))
        yield found
        found.close()


@pytest.fixture(scope="module")
def slot(slots: Slots) -> Iterator[Slot]:
    """One that plays all of them."""
    entries = tuple(each.entry for each in (*PLAYED, VARIES, *map(Odd, REFUSED)))
    by_id = {each.id: each for each in entries}
    odd = Slot(
        None,
        "bwrap",
        slots.folder / "odd",
        definitions=(*by_id.values(),),
        limits=EnvironmentLimits(call_s=8.0),
    )
    with slots.running(odd) as running:
        yield running


def sent(row: Row) -> float:
    """The action in a row: its push."""
    push = row.action["push"] if isinstance(row.action, dict) else row.action
    return round(float(push[0]), 2)


def replayed(slots: Slots, slot: Slot, env: str, outcome: EpisodeOutcome) -> EpisodeOutcome:
    job = make_job(env=env, bundle=None)
    spec = msgspec.structs.replace(job.episodes[0], replay=outcome.trajectory)
    job = msgspec.structs.replace(job, episodes=(spec,))
    (again,) = slots.run(slot.play_job(job, None, lambda *progress: None))
    return again


@pytest.mark.parametrize("odd", PLAYED, ids=lambda odd: odd.name)
def test_an_odd_environment_is_recorded_as_it_was_played(slots: Slots, slot: Slot, odd: Odd) -> None:
    policy = acting(odd.act, init="self.t = 0", before="import numpy as np")
    entry = odd.entry
    (description,) = slots.run(slot.describe([entry.id]))
    assert description.deterministic is entry.deterministic
    full, hidden = (
        slots.play(policy, slot=slot, env=entry.id, record=record) for record in ("full", "actions")
    )
    assert full.failure is hidden.failure is None
    assert [sent(row) for row in rows(full)] == [sent(row) for row in rows(hidden)] == SENT
    if odd.rewards is not None:
        assert [row.reward for row in rows(full)] == pytest.approx(odd.rewards)
    for key, value in (odd.infos or {}).items():
        assert rows(full)[2].info[key] == value, key
    assert not any(set(row.info) & {"policy_failed", "action_invalid"} for row in rows(full))
    if entry.deterministic:
        assert full.trajectory == replayed(slots, slot, entry.id, full).trajectory


def test_an_episode_of_more_than_16_mib_arrives_whole_and_is_replayed(slots: Slots, slot: Slot) -> None:
    entry = Odd("Noise").entry
    (outcome,) = slots.play_all(None, slot=slot, env=entry.id, render=True)
    assert outcome.trajectory is not None
    assert outcome.trajectory.inline is not None
    assert outcome.trajectory.size > 17 << 20
    assert digest_of(outcome.trajectory.inline) == outcome.trajectory.digest
    assert set(checked_files(outcome.trajectory.inline, N, N)) == {ROWS, OBSERVATIONS}
    # The recording is also on the way in, when it is played again.
    full = slots.play_all(None, slot=slot, env=entry.id)[0]
    assert replayed(slots, slot, entry.id, full).trajectory == full.trajectory


@pytest.mark.parametrize("name", REFUSED)
def test_an_odd_environment_is_refused_with_its_remedy(slots: Slots, slot: Slot, name: str) -> None:
    with pytest.raises(WorkerError, match=REFUSED[name]):
        slots.run(slot.describe([Odd(name).entry.id]))
    slots.run(slot.start())


def test_a_close_has_a_limit_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    guard = calls.LimitGuard(USUAL)
    monkeypatch.setattr(calls, "current", calls.RunningCall())
    calls.current.begin("my/env", "close")
    told = [guard.check(100.0 + second) for second in range(40)]
    assert told.index(calls.hung("environment my/env, close", calls.CLOSE_S)) == 31


@pytest.mark.parametrize("deterministic", [True, False])
def test_only_a_deterministic_episode_goes_on_from_recorded_actions(
    slots: Slots, slot: Slot, deterministic: bool
) -> None:
    entry = Odd("Plain").entry if deterministic else VARIES.entry
    recorder = Recorder("actions")
    for _ in range(3):
        recorder.append(None, np.array([0.75], np.float32), 0.0, False, False, {})
    back = pack({0: PackedBegun(actions=recorder.finish())})
    assert back is not None
    begun = BlobRef(digest=digest_of(back.data), size=len(back.data), inline=back.data)
    policy = acting(PUSH, init="self.t = 0", before="import numpy as np")
    outcome = slots.play(policy, slot=slot, env=entry.id, record="actions", begun=begun)
    earlier = [0.75] * 3 if deterministic else SENT[:3]
    assert [sent(row) for row in rows(outcome)] == earlier + SENT[3:]
