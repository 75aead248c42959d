"""All bytes from a policy's process are bounded and checked before they are used, and never cost the slot or
the episode.

Attacks, each with its defence:
- forges a report or an action that breaks its reader or encoder: bounds at the reader; each outcome is
  encoded within the error handling of its own episode.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from slots import QUICK, Slots, acting, category_of, failure_of, make_job, misbehaving

from evopolicy_common.errors import WorkerError
from evopolicy_common.messages.episode import EpisodeOutcome
from evopolicy_common.messages.worker import JobResult, ReportResults
from evopolicy_common.records.episodes.trajectory import Recorder
from evopolicy_common.wire import codec
from evopolicy_worker import environments
from evopolicy_worker.environments.families.toy import MassOnLine
from evopolicy_worker.environments.interface.actions import compile_actions
from evopolicy_worker.episodes import frames
from evopolicy_worker.episodes.loop import JobPlayer, _blob
from evopolicy_worker.episodes.monitor import Monitor
from evopolicy_worker.episodes.policies import RunningJob
from evopolicy_worker.episodes.policy_process import PolicyProcess
from evopolicy_worker.sandbox import jail
from evopolicy_worker.sandbox.inside import policy_server as shim
from evopolicy_worker.sandbox.zygote import Zygote
from evopolicy_worker.slot_protocol import slot_messages as messages
from evopolicy_worker.slots.slot import bundle_files

SPACES: list[dict[str, Any]] = [
    {"type": "Discrete", "n": 5},
    {"type": "Box", "shape": [3], "dtype": "float32", "low": [-1.0] * 3, "high": [1.0] * 3},
    {"type": "Box", "shape": [2, 2], "dtype": "int64", "low": [["-inf"] * 2] * 2, "high": [["inf"] * 2] * 2},
    {"type": "MultiDiscrete", "nvec": [4, 4]},
    {"type": "MultiBinary", "n": [2, 3]},
    {"type": "Text", "min_length": 1, "max_length": 9},
]
PARTS = [{"type": "Discrete", "n": 9}, {"type": "Dict", "spaces": {"a": {"type": "Discrete", "n": 2}}}]
SPACES.append({"type": "Tuple", "spaces": PARTS})
CODECS = [compile_actions(space) for space in SPACES]

PLAYED = EpisodeOutcome(index=0, episode_return=0.0, length=1, terminated=False, truncated=True)
NUMBERS = st.one_of(st.integers(), st.integers(10**18, 10**40), st.floats(), st.booleans(), st.none())
VALUES: st.SearchStrategy[Any] = st.recursive(
    st.one_of(NUMBERS, st.text(max_size=8), st.binary(max_size=8)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=12,
)
ARRAYS = st.builds(
    lambda code, shape, data: struct.pack(f"<4sI{len(shape)}I", code, len(shape), *shape) + data,
    st.sampled_from([*frames._DTYPES, b"|O\0\0", b"<M8\0"]),
    st.lists(st.integers(0, 4), max_size=3),
    st.binary(max_size=64),
)
PAYLOADS = st.one_of(
    st.binary(max_size=80),
    ARRAYS,
    VALUES.map(lambda value: _packed(value)),
    st.builds(
        lambda code, data: struct.pack(">BBb", 0xC7, len(data), code) + data, st.integers(-3, 4), ARRAYS
    ),
    st.integers(0, 10**400).map(
        lambda number: struct.pack(">BHb", 0xC8, len(str(number)), 2) + str(number).encode()
    ),
)


def _packed(value: Any) -> bytes:
    out = bytearray()
    try:
        shim.pack(value, out, 0)
    except ValueError:
        return b"\xc0"
    return bytes(out)


@settings(max_examples=400, deadline=None)
@given(st.integers(0, 8), st.lists(PAYLOADS, min_size=1, max_size=3), st.sampled_from(range(len(SPACES))))
def test_whatever_comes_as_an_action_reaches_the_hand_in_whole(
    tag: int, payloads: list[bytes], which: int
) -> None:
    recorder = Recorder("full")
    played = Recorder("actions")
    for payload in payloads:
        try:
            returned = frames.action(tag, payload)
        except frames.BadReplyError:
            continue
        action, _ = CODECS[which].repair(returned)
        recorder.append(0, returned, 0.0, False, False, {})
        played.append(None, action, 0.0, False, False, {})
    for each in (recorder, played):
        outcome = msgspec.structs.replace(PLAYED, trajectory=_blob(each.finish()))
        assert results_reported(outcome) == outcome


def finished(frame: bytes) -> list[EpisodeOutcome]:
    message = messages.replies.decode(frame[messages.LENGTH.size :])
    return [message.outcome] if isinstance(message, messages.Finished) else []


def results_reported(outcome: EpisodeOutcome) -> EpisodeOutcome:
    """The outcome after its way from the slot's process through the supervisor to the coordinator."""
    (outcome,) = finished(messages.framed(messages.Finished(outcome=outcome)))
    result = JobResult(lease_id="l", job_id="j", attempt=1, kind="done", episodes=(outcome,))
    sent = codec.encode(ReportResults(worker="w", session="s", results=(result,)))
    message = codec.decode(codec.worker_requests, sent)
    assert isinstance(message, ReportResults)
    return message.results[0].episodes[0]


REPORTS = st.fixed_dictionaries(
    {
        "stage": st.one_of(st.sampled_from(["import", "init", "reset", "act"]), VALUES),
        "kind": st.one_of(
            st.sampled_from(["memory", "files", "inodes", "descriptors", "processes", "action", None]), VALUES
        ),
        "message": st.one_of(st.text(max_size=40), VALUES),
        "traceback": st.one_of(st.text(max_size=40), VALUES),
    },
    optional={"missing": st.one_of(st.text(max_size=9), VALUES), "used": st.one_of(NUMBERS, VALUES)},
)


def plain(value: Any) -> Any:
    """As JSON can hold it."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, list) else value


@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(REPORTS, st.sampled_from(["init", "reset", "act"]))
def test_whatever_comes_as_a_report_is_a_bounded_failure(
    policy: PolicyProcess, report: dict[str, Any], what: str
) -> None:
    error = policy._reported_failure(
        shim.FAILED, json.dumps(plain(report)).encode("utf-8", "surrogatepass"), what
    )
    failure = error.failure
    assert len(failure.message) <= 2000
    assert len(failure.traceback) <= 16_000
    assert failure.used is None or 0 <= failure.used <= 1 << 53
    outcome = msgspec.structs.replace(PLAYED, failure=failure)
    assert results_reported(outcome) == outcome


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory, monitor: Monitor) -> Iterator[PolicyProcess]:
    """A policy's process that is as good as dead, so that a broken frame costs no more."""
    folder = tmp_path_factory.mktemp("policy")
    plan = jail.plan("none", folder, ("numpy",))
    zygote = Zygote(plan, folder)
    found = PolicyProcess(zygote, zygote.spawn(), monitor, plan, QUICK, str(folder))
    found._watch.what = "act"
    found._bury()
    found._bury = lambda: None  # type: ignore[method-assign]
    yield found
    zygote.close()


@pytest.mark.parametrize("used", ["1" + "0" * 30, "-1", str(1 << 63), "1e400", "NaN"])
def test_a_forged_count_costs_the_episode_and_not_the_slot(slots: Slots, used: str) -> None:
    report = f'{{"stage":"act","kind":"action","message":"m","traceback":"","used":{used}}}'
    forged = f"b = {report.encode()!r}; os.write(4, struct.pack('<IBxxx', len(b), 6) + b); time.sleep(60)"
    outcome = slots.play(misbehaving(act=forged))
    assert category_of(outcome) == "killed"
    assert outcome.length == 60


FORGER = """
import json, os, random, struct

class Policy:
    def __init__(self, *spaces):
        self.n = 0

    def reset(self, episode_index):
        self.dice = random.Random(episode_index)
        self.at = self.dice.choice([0, 0, 1, 7, 59])
        if self.at == 0:
            self.forge()

    def act(self, obs):
        self.n += 1
        if self.n == self.at + 1:
            self.forge()
        return [0.0]

    def forge(self):
        dice = self.dice
        tag = dice.randrange(9)
        payload = dice.choice([
            dice.randbytes(dice.randrange(64)),
            json.dumps({"stage": "act", "kind": dice.choice(["action", "memory", None, 3]), "message": "m" * dice.choice([1, 9999]),
                        "traceback": "", "used": dice.choice([None, -1, 10**30, 1e300, 7])}).encode(),
            struct.pack("<4sI2I", b"<f8\\0", 2, dice.randrange(1 << 32), dice.randrange(1 << 32)),
            bytes([0xC7, 8, 1]) + struct.pack("<4sI", b"<f8\\0", dice.randrange(1 << 32)),
            bytes([0xDD]) + dice.randbytes(4) + b"\\x90" * dice.randrange(99),
        ])
        length = dice.choice([len(payload), len(payload), len(payload), dice.randrange(1 << 32)])
        os.write(4, struct.pack("<IBxxx", length, tag) + payload)
        if dice.random() < 0.3:
            os._exit(dice.randrange(256))
"""  # noqa: E501


@pytest.mark.parametrize("scope", ["episode", "submit"])
def test_no_forged_frame_costs_more_than_its_own_episode(slots: Slots, scope: str) -> None:
    limits = msgspec.structs.replace(QUICK, act_wall_s=0.3)
    slot = slots.slot()
    pid = slot._process.pid if slot._process is not None else 0
    outcomes = slots.play_all(FORGER, n=60, policy_scope=scope, limits=limits)
    assert [outcome.length for outcome in outcomes] == [60] * 60
    failures = [outcome.failure for outcome in outcomes if outcome.failure is not None]
    assert len(failures) > 30
    assert "killed" in {failure.category for failure in failures}
    assert slot._process is not None
    assert slot._process.pid == pid


class Fragile(MassOnLine):
    """Breaks when it is pushed to the right with all strength."""

    how = "raise"

    def step(self, action: Any) -> Any:
        found = super().step(action)
        if float(action[0]) == 1.0:
            if self.how == "raise":
                raise RuntimeError("mj_step: unknown element of seed 4711")
            if self.how == "disk":
                raise OSError(28, "No space left on device")
            return found._replace(reward=math.inf)
        return found


BREAKER = misbehaving(act="return [1.0]")


@pytest.fixture
def player(tmp_path: Path, monitor: Monitor, monkeypatch: pytest.MonkeyPatch) -> Iterator[JobPlayer]:
    toy = environments.make("toy/line")
    monkeypatch.setattr(environments, "make", lambda env_id, **options: Fragile.__new__(Fragile))
    monkeypatch.setattr(Fragile, "__new__", lambda cls: _like(cls, toy))
    plan = jail.plan("none", tmp_path, ("numpy",))
    zygote = Zygote(plan, tmp_path)
    yield JobPlayer(zygote, plan, monitor, tmp_path)
    zygote.close()


def _like(cls: Any, toy: Any) -> Any:
    made = object.__new__(cls)
    vars(made).update(vars(toy))
    return made


def play(player: JobPlayer, slots: Slots, source: str, n: int = 1, **options: Any) -> list[EpisodeOutcome]:
    job = make_job(tier="none", n=n, **options)
    outcomes: list[EpisodeOutcome] = []
    bundle = bundle_files(slots.bundle(source))
    last = player.play_job(job, bundle, RunningJob(), lambda frame: outcomes.extend(finished(frame)))
    outcomes.extend(finished(last))
    return outcomes


@pytest.mark.parametrize("how", ["raise", "infinite reward"])
def test_an_action_that_breaks_the_environment_is_the_policys_failure(
    player: JobPlayer, slots: Slots, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    monkeypatch.setattr(Fragile, "how", how)
    (outcome,) = play(player, slots, BREAKER)
    failure = failure_of(outcome)
    assert (failure.category, failure.step_index) == ("killed", None)
    assert "the environment broke down" in failure.message
    assert "4711" not in failure.message
    # It is worth what random actions are, from the first step on.
    alone = slots.play(misbehaving(reset="raise ValueError"))
    assert outcome.episode_return == alone.episode_return
    assert outcome.length == 60


def test_failures_before_the_first_action_are_ours(
    player: JobPlayer, slots: Slots, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Fragile, "how", "disk")
    with pytest.raises(OSError, match="No space left"):
        play(player, slots, BREAKER)

    def reset(self: Fragile, case: Any) -> Any:
        raise RuntimeError("no model file")

    monkeypatch.setattr(Fragile, "reset", reset)
    with pytest.raises(RuntimeError, match="no model file"):
        play(player, slots, BREAKER)


def test_an_environment_that_breaks_without_a_policy_is_ours(
    player: JobPlayer, slots: Slots, monkeypatch: pytest.MonkeyPatch
) -> None:
    def step(self: Fragile, action: Any) -> Any:
        raise RuntimeError("broken anyway")

    monkeypatch.setattr(Fragile, "step", step)
    # With the policy's actions and with random ones alike.
    with pytest.raises(RuntimeError, match="broken anyway"):
        play(player, slots, BREAKER)


def test_after_a_broken_environment_the_jobs_other_episodes_go_on(player: JobPlayer, slots: Slots) -> None:
    act = "self.n += 1\nreturn [1.0 if self.n == 4 and self.e == 2 else 0.0]"
    source = acting(act, reset="self.e, self.n = episode_index, 0")
    outcomes = play(player, slots, source, n=3, policy_scope="submit")
    assert [outcome.failure is not None for outcome in outcomes] == [False, True, False]


def test_an_answer_of_a_slots_process_that_is_none_is_reported(slots: Slots) -> None:
    slot = slots.new()

    async def work() -> None:
        await slot.start()
        process = slot._process
        assert process is not None
        assert process.stdout is not None
        process.stdout.feed_data(messages.LENGTH.pack(3) + b"abc")
        job = make_job(bundle=None, n=200, policy_scope="submit")
        with pytest.raises(WorkerError, match="cannot be read"):
            await slot.play_job(job, None, lambda *progress: None)
        await slot.close()

    slots.run(work())
