"""Feedback as bytes: numbers, lines, summaries, stored observations."""

from __future__ import annotations

import io
import json
import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rigs.finished_run import played_episode

from evopolicy_common.messages.environment import ObservationForm, ObsStorage
from evopolicy_common.messages.episode import PolicyFailure, ResourceLimits
from evopolicy_common.messages.gateway import EpisodeFeedback, FeedbackDetail, SubmitDone
from evopolicy_common.records.episodes.rendered import decode, files_of
from evopolicy_common.records.episodes.trajectory import Recorder
from evopolicy_common.records.json_text import json_bytes
from evopolicy_common.records.summary import decode_summary
from evopolicy_gateway.run_folder.layout import episode_name, submit_id
from evopolicy_gateway.submits.episode_files import LEFT_OUT_FIRST, episode_files, episode_share, within_share
from evopolicy_gateway.submits.formatting import (
    MAX_TEXT_BYTES,
    failure_line,
    summary_bytes,
    verdict_line,
)


def trajectory_files(packed: bytes, storage: ObsStorage | None) -> dict[str, bytes]:
    return files_of(decode(packed), storage)


def done(n: int, status: Any = "ok", **fields: Any) -> SubmitDone:
    usual: dict[str, Any] = {"status": status, "n_episodes": n, "n_kept": n, "failure": None}
    usual |= {"env_instances": tuple(range(n)), "first_global_episode": 4, "remaining_budget": 7}
    return SubmitDone(**usual | {"started_at": 100.0, "completed_at": 101.25} | fields)


def scores(returns: list[float]) -> list[EpisodeFeedback]:
    return [played_episode(index=i, episode_return=r, length=i + 1) for i, r in enumerate(returns)]


values = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text()),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(st.text(), inner, max_size=4)),
    max_leaves=12,
)


def named(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Inf" if value > 0 else "-Inf"
    if isinstance(value, list):
        return [named(item) for item in value]
    if isinstance(value, dict):
        return {key: named(item) for key, item in value.items()}
    return value


@given(values)
def test_any_value_comes_back_with_its_odd_numbers_named(value: Any) -> None:
    assert json.loads(json_bytes(value)) == named(value)


@given(st.lists(st.floats(width=32), max_size=6), st.sampled_from(["float32", "float64"]))
def test_arrays_are_written_as_the_numbers_of_their_own_dtype(numbers: list[float], dtype: str) -> None:
    array = np.array(numbers, dtype=dtype)
    back = json.loads(json_bytes({"a": array}))["a"]
    special = {"NaN": math.nan, "Inf": math.inf, "-Inf": -math.inf}
    restored = np.array([special.get(x, x) if isinstance(x, str) else x for x in back], dtype=dtype)
    np.testing.assert_array_equal(restored, array)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (np.float32(0.1), b"0.1"),
        (np.array(3, dtype=np.int64), b"3"),
        (np.array([True, False]), b"[true,false]"),
        (np.array([[1, 2], [3, 4]], dtype=np.uint8), b"[[1,2],[3,4]]"),
        (np.array([1.0, np.nan], dtype=np.float32), b'[1.0,"NaN"]'),
        (np.array([1.5], dtype=np.longdouble), b"[1.5]"),
        ((1, [np.inf]), b'[1,["Inf"]]'),
        ({1: -np.inf}, b'{"1":"-Inf"}'),
        (2**70, b"1180591620717411303424"),
        ("\ud800", b'"\\ud800"'),
        ({"a": np.array([0.5], dtype=np.float32), "b": 2**70}, b'{"a":[0.5],"b":1180591620717411303424}'),
        (b"\xff", b'"\\\\xff"'),
        (np.array([1.0, 2.0])[::-1], b"[2.0,1.0]"),
    ],
)
def test_odd_values_have_one_form(value: Any, text: bytes) -> None:
    assert json_bytes(value) == text


def test_names_are_padded_to_the_budgets_digits() -> None:
    assert submit_id(7, 128) == "submit_007"
    assert submit_id(7, 10_000) == "submit_00007"
    assert episode_name(127, 128) == "ep_127"


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30))
def test_a_summary_tells_mean_and_population_deviation(returns: list[float]) -> None:
    summary = decode_summary(summary_bytes("toy/line", 3, done(len(returns)), scores(returns)[::-1]))
    assert summary.returns == tuple(returns)
    assert summary.mean_return == pytest.approx(np.mean(returns), abs=1e-6)
    assert summary.std_return == pytest.approx(np.std(returns), rel=1e-6, abs=1e-6)
    assert (summary.min_return, summary.max_return) == (min(returns), max(returns))
    assert summary.episode_lengths == tuple(range(1, len(returns) + 1))


@given(st.permutations(list(range(8))))
def test_the_order_of_arrival_changes_no_byte(order: list[int]) -> None:
    given_scores = scores([0.1 * i for i in range(8)])
    assert summary_bytes("e", 0, done(8), [given_scores[i] for i in order]) == summary_bytes(
        "e", 0, done(8), given_scores
    )


def test_returns_that_are_not_finite_are_named_in_the_summary() -> None:
    document = json.loads(summary_bytes("e", 0, done(2), scores([math.inf, 1.0])))
    assert document["returns"] == ["Inf", 1.0]
    assert document["mean_return"] == "Inf"
    assert document["std_return"] == "NaN"


def test_a_summary_that_is_not_ok_has_every_array_and_aggregate_null() -> None:
    document = json.loads(summary_bytes("e", 0, done(5, "cancelled", n_kept=0), []))
    assert document["n_episodes"] == 5
    assert document["remaining_budget"] == 7
    stated = {key for key, value in document.items() if value is not None}
    assert stated == {
        *("schema_version", "submit_index", "env", "status", "n_episodes", "env_instances"),
        *("remaining_budget", "submit_started_at", "submit_completed_at", "wall_time_seconds"),
    }


def test_a_summary_of_missing_episodes_is_a_bug_not_a_file() -> None:
    with pytest.raises(ValueError, match="2 of 3 episodes"):
        summary_bytes("e", 0, done(3), scores([1.0, 2.0]))


@pytest.mark.parametrize("form", ["arrays", "lists"])
def test_a_policy_that_failed_in_every_episode_is_reported_loudly(form: ObservationForm) -> None:
    failure = PolicyFailure(category="act_error", step_index=0, message="ValueError: ambiguous", traceback="")
    failed = [played_episode(index=i, episode_return=1.0, length=9, failure=failure) for i in range(3)]
    document = json.loads(summary_bytes("e", 0, done(3), failed, form))
    assert (document["status"], document["policy_failures"]) == ("ok", 3)
    for word in ("ALL 3 episodes", "at step 0", "ValueError: ambiguous", "nothing about your policy"):
        assert word in document["warning"]
    assert ("arrive as numpy arrays" in document["warning"]) == (form == "arrays")
    document = json.loads(summary_bytes("e", 0, done(4), [*failed, *scores([1.0] * 4)[3:]], form))
    assert document["warning"].startswith("the policy failed in 3 of 4 episodes")
    document = json.loads(summary_bytes("e", 0, done(3), scores([1.0] * 3), form))
    assert document["policy_failures"] == 0
    assert "warning" not in document


def test_reward_components_are_meant_over_episodes() -> None:
    with_parts = [
        played_episode(index=i, episode_return=0.0, length=1, reward_components={"a": float(i)})
        for i in range(3)
    ]
    document = json.loads(summary_bytes("e", 0, done(3), with_parts))
    assert document["reward_components_mean"] == {"a": 1.0}
    assert document["reward_components_per_episode"] == [{"a": 0.0}, {"a": 1.0}, {"a": 2.0}]
    assert "reward_components_mean" not in json.loads(summary_bytes("e", 0, done(1), scores([1.0])))


@given(st.text(max_size=300), st.integers(0, 200_000), st.sampled_from(["x", "é", "\x00", "😀"]))
def test_an_error_line_is_one_json_line_of_at_most_64_kib(message: str, n: int, filler: str) -> None:
    failure = PolicyFailure(
        category="act_error", step_index=3, message=message, traceback=filler * n + "the end"
    )
    data = failure_line(failure, 0.0)
    assert len(data) <= MAX_TEXT_BYTES
    assert data.count(b"\n") == 1
    line = json.loads(data)
    assert line["step_index"] == 3
    assert line["traceback"].endswith("the end")
    assert line["message"] == message


def test_a_message_without_end_is_cut() -> None:
    failure = PolicyFailure(
        category="import_error", step_index=None, message="m" * 10**6, traceback="t" * 10**6
    )
    assert len(verdict_line("import_error", failure, 0.0)) <= MAX_TEXT_BYTES


def test_a_verdict_names_its_cause_when_that_has_another_name() -> None:
    oom = PolicyFailure(category="oom", step_index=None, message="used 2 GB")
    line = json.loads(verdict_line("init_error", oom, 0.0))
    assert (line["category"], line["message"]) == ("init_error", "oom: used 2 GB")


def packed(observations: list[Any], actions: list[Any] | None = None, form: Any = "arrays") -> bytes:
    recorder = Recorder(observations=form)
    for t, obs in enumerate(observations):
        action = actions[t] if actions else 0
        recorder.append(obs, action, float(t), t == len(observations) - 1, False, {"k": t})
    return recorder.finish()


def test_dicts_with_pictures_are_stored_by_part() -> None:
    observations = [
        {"view": np.full((2, 2), t, dtype=np.uint8), "text": f"go {t}", "pair": (t, np.array([0.5 * t]))}
        for t in range(2)
    ]
    files = trajectory_files(packed(observations), "npz")
    stored = np.load(io.BytesIO(files["observations.npz"]), allow_pickle=False)
    assert sorted(stored.files) == ["pair/0", "pair/1", "text", "view"]
    assert stored["text"].tolist() == ["go 0", "go 1"]
    assert stored["view"].shape == (2, 2, 2)
    assert stored["pair/0"].tolist() == [0, 1]
    assert files["observations.npz"] == trajectory_files(packed(observations), "npz")["observations.npz"]


def test_a_policy_that_asked_for_lists_sees_lists_in_its_rows() -> None:
    files = trajectory_files(packed([np.array([[1.0, np.nan]], dtype=np.float32)], form="lists"), "inline")
    assert json.loads(files["trajectory.jsonl"])["obs"] == [[1.0, "NaN"]]
    assert list(files) == ["trajectory.jsonl"]


def test_an_action_that_is_no_action_is_written_as_it_was_returned() -> None:
    odd = [None, "left", [1, "x"], float("nan"), {"a": 1}, 2**80]
    files = trajectory_files(packed([np.zeros(1)] * len(odd), odd), "inline")
    actions = [json.loads(line)["action"] for line in files["trajectory.jsonl"].splitlines()]
    assert actions == [None, "left", [1, "x"], "NaN", {"a": 1}, 2**80]


def test_streams_are_cut_and_videos_kept() -> None:
    episode = played_episode(stdout=b"x" * (MAX_TEXT_BYTES + 5))
    files = episode_files(episode, packed([np.zeros(1)]), b"mp4", "inline", at=0.0, share=1 << 20)
    assert len(files["stdout.txt"]) == MAX_TEXT_BYTES
    assert files["video.mp4"] == b"mp4"
    assert sorted(files) == ["stderr.txt", "stdout.txt", "trajectory.jsonl", "video.mp4"]


SECRET = "the observation was 0.123"


def shown(detail: FeedbackDetail, storage: ObsStorage) -> dict[str, bytes]:
    """Files of an episode whose policy wrote what it observed wherever it can."""
    failure = PolicyFailure(category="act_error", message=SECRET, traceback=SECRET, step_index=1)
    episode = played_episode(failure=failure, stdout=SECRET.encode(), stderr=SECRET.encode())
    observation = np.zeros((4, 5, 3), dtype=np.uint8) if storage == "npz" else np.zeros(1)
    rows = b"" if detail == "scores" else packed([observation])
    return episode_files(episode, rows, b"mp4", storage, at=0.0, share=1 << 20, detail=detail)


TEXTS = {"stdout.txt", "stderr.txt", "error.txt"}


@pytest.mark.parametrize(
    ("detail", "storage", "names"),
    [
        ("scores", "inline", {"error.txt"}),
        ("scores", "npz", {"error.txt"}),
        ("trajectories", "inline", {"trajectory.jsonl", *TEXTS}),
        ("trajectories", "npz", {"trajectory.jsonl", "error.txt"}),
        ("pictures", "inline", {"trajectory.jsonl", "video.mp4", *TEXTS}),
        ("pictures", "npz", {"trajectory.jsonl", "observations.npz", "video.mp4", *TEXTS}),
    ],
)
def test_a_level_of_detail_has_its_files_and_hides_the_rest(
    detail: FeedbackDetail, storage: ObsStorage, names: set[str]
) -> None:
    files = shown(detail, storage)
    assert set(files) == names
    texts = SECRET.encode() in b"".join(files.values())
    assert texts == ("stdout.txt" in names)
    line = json.loads(files["error.txt"])
    assert (line["category"], line["step_index"]) == ("act_error", 1)


def test_a_warning_without_messages_still_says_where_the_policy_failed() -> None:
    failure = PolicyFailure(category="act_error", message=SECRET, traceback="", step_index=1)
    failed = played_episode(index=0, episode_return=1.0, length=2, failure=failure)
    text = summary_bytes("toy/line", 0, done(1), [failed], messages=False).decode()
    assert SECRET not in text
    assert "first at step 1, act_error)" in text
    assert SECRET in summary_bytes("toy/line", 0, done(1), [failed]).decode()


def test_an_episode_without_a_step_has_an_empty_trajectory() -> None:
    assert trajectory_files(packed([]), "npy") == {"trajectory.jsonl": b""}


@pytest.mark.parametrize(
    ("share", "left_out"), [(600, 0), (599, 1), (301, 1), (300, 1), (299, 2), (100, 2), (99, 3), (0, 3)]
)
def test_files_beyond_an_episodes_share_are_left_out_in_order(share: int, left_out: int) -> None:
    files = {"trajectory.jsonl": b"r" * 100, "observations.npz": b"o" * 200, "video.mp4": b"v" * 300}
    kept = within_share(files, share)
    order = [name for name in LEFT_OUT_FIRST if name in files]
    assert set(files) - set(kept) == set(order[:left_out])
    listed = kept.get("left_out.txt", b"").decode()
    assert [name for name in order if name in listed] == order[:left_out]
    assert (f"{share:,} bytes" in listed) == bool(left_out)


def test_every_episode_of_a_run_has_the_same_share_of_its_feedback() -> None:
    assert episode_share(ResourceLimits(feedback_bytes=1000), 3) == 333
    assert 128 * episode_share(ResourceLimits(), 128) == 16 << 30


def test_a_played_submit_with_failed_episodes_has_all_but_mean_and_deviation() -> None:
    failure = PolicyFailure(category="act_error", step_index=2, message="no")
    played = scores([1.0, 3.0])
    played[1] = msgspec.structs.replace(played[1], failure=failure)
    summary = decode_summary(
        summary_bytes("toy/line", 0, done(2, "rollout_timeout", failure=failure), played)
    )
    assert (summary.status, summary.mean_return, summary.std_return) == ("rollout_timeout", None, None)
    assert (summary.returns, summary.min_return, summary.max_return) == ((1.0, 3.0), 1.0, 3.0)
    assert (summary.errors, summary.policy_failures, summary.first_global_episode) == ((1,), 1, 4)
    assert "ended there" in (summary.warning or "")
    assert "Random actions" not in (summary.warning or "")
