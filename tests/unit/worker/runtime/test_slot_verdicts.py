"""Each way in which a policy can fail gets its own verdict, and the episode is played on."""

from __future__ import annotations

import msgspec
import pytest
from slots import HONEST, QUICK, Slots, category_of, failure_of, misbehaving, rows

from evopolicy_common.messages.episode import EpisodeOutcome, ResourceLimits
from evopolicy_worker import environments
from evopolicy_worker.episodes import frames
from evopolicy_worker.episodes.loop import random_actions


def limits(**changes: float) -> ResourceLimits:
    return msgspec.structs.replace(QUICK, **changes)


def played_on_with_random_actions(outcome: EpisodeOutcome, step: int) -> bool:
    played = rows(outcome)
    line = environments.make("toy/line")
    rng = random_actions(bytes(range(16)))
    return len(played) == 60 and all(
        (row.info.get("policy_failed") is True) == (row.t >= step)
        and (row.t < step or row.action.tobytes() == line.action_codec.sample(rng).tobytes())
        for row in played
    )


FAILS = {
    "act_error": {
        "raise ValueError('of no use')": "ValueError: of no use",
        "sys.exit(0)": "SystemExit",
        "raise KeyboardInterrupt": "KeyboardInterrupt",
        "self.act(obs) if False else (lambda f: f(f))(lambda f: f(f))": "recursion",
        "return [None] * 2000": "2,001 values; 1,025 are the limit",
        "return np.zeros(5000)": "40,000 bytes; 16,400 are the limit",
        "raise ValueError('\\ud800')": "ValueError: \\ud800",
        "raise type('E', (OSError,), {'errno': property(lambda s: 1 / 0)})": "cannot be shown",
    },
    "killed": {
        "os._exit(7)": "exited with status 7",
        "import ctypes; ctypes.string_at(0)": "SIGSEGV",
        "os.abort()": "SIG",
    },
    "oom": {"bytearray(1 << 30)": "268,435,456 bytes", "np.ones(1 << 28)": "268,435,456 bytes"},
    "file_limit": {
        "open('/tmp/big', 'wb').write(bytes(8 << 20))": "4,194,304 bytes",
        "[open(f'/tmp/{k}', 'wb').write(bytes(1 << 20)) for k in range(8)]": "No space left",
        "self.f = [open('/dev/null') for _ in range(999)]": "256 open descriptors",
    },
    "process_limit": {
        "[threading.Thread(target=time.sleep, args=(9,)).start() for _ in range(99)]": "8 threads",
        "os.fork()": "may be started",
        "import subprocess; subprocess.run(['/bin/true'])": "no process",
    },
}
"""Code for `act` and a part of the failure's message, by its category."""


@pytest.mark.parametrize(
    ("source", "category", "step", "words"),
    [
        (misbehaving(reset="raise KeyError('left')"), "reset_error", None, "KeyError: 'left'"),
        *(
            (misbehaving(act=act), category, 3, words)
            for category, acts in FAILS.items()
            for act, words in acts.items()
        ),
    ],
)
def test_a_policy_that_fails_gets_its_verdict_and_is_replaced(
    slots: Slots, source: str, category: str, step: int | None, words: str
) -> None:
    outcome = slots.play(source)
    failure = failure_of(outcome)
    assert (failure.category, failure.step_index) == (category, step)
    assert words in failure.message
    assert played_on_with_random_actions(outcome, step or 0)
    assert slots.play(HONEST).failure is None


@pytest.mark.parametrize(
    ("source", "changes", "category", "limit"),
    [
        (misbehaving(act="time.sleep(60)"), {"act_wall_s": 0.3}, "act_timeout", 0.3),
        (misbehaving(reset="time.sleep(60)"), {"act_wall_s": 0.3}, "act_timeout", 0.3),
        (misbehaving(act="time.sleep(60)"), {"episode_wall_s": 0.4}, "episode_timeout", 0.4),
        (misbehaving(act="[0 for _ in iter(int, 1)]"), {"cpu_s": 0.5, "act_wall_s": 20.0}, "cpu_limit", 0.5),
        (
            misbehaving(act="import signal; signal.pthread_sigmask(0, range(1, 64)); time.sleep(60)"),
            {"act_wall_s": 0.3},
            "act_timeout",
            0.3,
        ),
    ],
)
def test_a_time_limit_is_reported_with_value_and_use(
    slots: Slots, source: str, changes: dict[str, float], category: str, limit: float
) -> None:
    failure = failure_of(slots.play(source, limits=limits(**changes)))
    assert (failure.category, failure.limit) == (category, limit)
    assert failure.used is not None
    assert limit < failure.used < limit + 5


@pytest.mark.parametrize(
    ("source", "category", "words"),
    [
        ({"other.py": ""}, "missing_policy", "no policy.py"),
        (
            {"policy.py": "import os\ndef f(:"},
            "import_error",
            "SyntaxError: invalid syntax (policy.py, line 2)",
        ),
        ({"policy.py": "1 / 0"}, "import_error", "ZeroDivisionError"),
        ({"policy.py": "import numpi"}, "import_error", "No module named 'numpi'"),
        ({"policy.py": "policy = 3"}, "import_error", "no top-level class named Policy"),
        ({"policy.py": "import gymnasium"}, "denied_import", "policies may not import gymnasium"),
        ({"policy.py": "from evopolicy_common import codec"}, "denied_import", "evopolicy_common"),
        ({"policy.py": misbehaving(init="raise OSError('no')")}, "init_error", "OSError: no"),
        ({"policy.py": "class Policy: pass"}, "init_error", "takes no arguments"),
        ({"policy.py": misbehaving(init="time.sleep(60)")}, "init_error", "longer than 0.5 s"),
        ({"policy.py": misbehaving(init="os._exit(4)")}, "init_error", "exited with status 4"),
        ({"policy.py": misbehaving(init="bytearray(1 << 30)")}, "init_error", "268,435,456"),
    ],
)
def test_a_bundle_without_a_policy_is_reported_at_index_0(
    slots: Slots, source: dict[str, str | bytes], category: str, words: str
) -> None:
    at_first = slots.play(source, first=0, limits=limits(init_wall_s=0.5))
    failure = failure_of(at_first)
    assert failure.category == category
    assert words in failure.message
    assert (at_first.length, at_first.trajectory, at_first.episode_return) == (0, None, 0.0)


def test_a_bundle_without_a_policy_is_a_later_episodes_own_failure(slots: Slots) -> None:
    for later in (slots.play("1 / 0", first=2), slots.play("1 / 0", first=0, record="actions")):
        assert category_of(later) == "import_error"
        assert later.length == 60
    assert played_on_with_random_actions(slots.play("1 / 0", first=2), 0)


def test_a_submit_that_yields_no_policy_has_an_outcome_for_every_episode(slots: Slots) -> None:
    outcomes = slots.play_all("1 / 0", first=0, n=3, policy_scope="submit")
    assert [outcome.index for outcome in outcomes] == [0, 1, 2]
    assert {outcome.failure.category for outcome in outcomes if outcome.failure} == {"import_error"}
    assert {outcome.length for outcome in outcomes} == {0}


def test_limits_of_files_and_actions_are_the_jobs_own(slots: Slots) -> None:
    few = limits(open_files=40, files=20, action_bytes=512)
    acts = {
        "self.f = [open('/dev/null') for _ in range(60)]": ("file_limit", "40 open descriptors"),
        "[open(f'f{k}', 'w') for k in range(60)]": ("file_limit", "20 files and folders are the limit"),
        "return [0.0] * 99": ("act_error", "more than 528 bytes"),
    }
    for act, (category, words) in acts.items():
        source = misbehaving(act=act)
        assert slots.play(source, limits=limits(files=1000)).failure is None
        failure = failure_of(slots.play(source, limits=few))
        assert failure.category == category
        assert words in failure.message


def test_a_policy_that_breaks_its_player_is_told_so(slots: Slots) -> None:
    failure = failure_of(slots.play(misbehaving(act="os.dup2(3, 4)")))
    assert "answers for the policy was broken" in failure.message


def test_a_full_file_system_is_reported_whatever_way_it_was_filled(slots: Slots) -> None:
    mapped = "import mmap; k = os.open('s', 66); os.truncate(k, 4 << 20); m = mmap.mmap(k, 4 << 20); "
    filled = "open('t', 'wb').write(bytes(3 << 20)); m[:] = bytes(4 << 20)"
    failure = failure_of(slots.play(misbehaving(act=mapped + filled)))
    assert (failure.category, "SIGBUS" in failure.message) == ("killed", True)
    assert "4,194,304 bytes, the limit" in failure.message
    lost = "os.environ.clear(); os.chdir('/'); [open(f'/tmp/{k}', 'w').close() for k in range(60)]"
    failure = failure_of(slots.play(misbehaving(act=lost), limits=limits(files=20)))
    assert (failure.category, failure.limit) == ("file_limit", 20)


def test_a_limit_beyond_the_machines_own_is_the_machines(slots: Slots) -> None:
    vast = limits(open_files=1 << 40, processes=1 << 40, files=1 << 20, memory_bytes=1 << 60)
    assert slots.play(HONEST, limits=vast).failure is None


def test_a_forged_action_beyond_the_limit_ends_the_policy(slots: Slots) -> None:
    forged = "os.write(4, (20000).to_bytes(4, 'little') + bytes([5, 0, 0, 0]) + bytes(20000)); time.sleep(60)"
    failure = failure_of(slots.play(misbehaving(act=forged)))
    assert (failure.category, "20,000 bytes; 16,400 are the limit" in failure.message) == ("killed", True)


def test_what_a_policy_may_return_grows_with_the_action_space() -> None:
    box = {"type": "Box", "shape": [3, 4], "dtype": "float32"}
    text = {"type": "Text", "min_length": 0, "max_length": 9}
    spaces = {"a": box, "b": text, "c": {"type": "Discrete", "n": 5}}
    rest = [{"type": "MultiDiscrete", "nvec": [4, 4]}, {"type": "MultiBinary", "n": [2, 3]}]
    whole = {"type": "Tuple", "spaces": [{"type": "Dict", "spaces": spaces}, *rest]}
    assert frames.elements(whole) == 12 + 9 + 1 + 2 + 6


def test_a_traceback_shows_the_policys_lines_and_no_folder_of_the_worker(slots: Slots) -> None:
    failure = failure_of(slots.play(misbehaving(act="import json; json.loads('{')")))
    assert 'File "system/policy.py", line 16, in act' in failure.traceback
    assert "json/__init__.py" in failure.traceback
    assert "policy_server.py" not in failure.traceback
    assert "/home/" not in failure.traceback
    assert str(slots.folder) not in failure.traceback


def test_output_is_kept_up_to_its_limit_and_always_drained(slots: Slots) -> None:
    source = misbehaving(
        init="print('built')",
        act="""[os.write(2, b'e' * 1000) for _ in range(1000)]
            import ctypes
            for _ in range(30000): print('o' * 100)
            ctypes.CDLL(None).puts(b'from C')""",
    )
    outcome = slots.play(source, limits=limits(output_bytes=5000, act_wall_s=10.0))
    assert outcome.failure is None
    assert outcome.stdout == (b"built\n" + (b"o" * 100 + b"\n") * 60)[:5000]
    assert outcome.stderr == b"e" * 5000


def test_what_was_printed_before_an_end_is_kept(slots: Slots) -> None:
    for end in ("raise ValueError", "os._exit(1)", "time.sleep(60)"):
        outcome = slots.play(misbehaving(act=f"print('last words'); {end}"), limits=limits(act_wall_s=0.3))
        assert outcome.stdout == b"last words\n"


def test_output_of_c_code_is_kept(slots: Slots) -> None:
    outcome = slots.play(misbehaving(act="import ctypes; ctypes.CDLL(None).printf(b'from C')"))
    assert outcome.stdout == b"from C"


@pytest.mark.parametrize("tier", ["landlock", "none"])
def test_verdicts_are_the_same_in_the_other_tiers(slots: Slots, tier: str) -> None:
    threads = "[threading.Thread(target=time.sleep, args=(9,)).start() for _ in range(20)]; time.sleep(60)"
    expected = {
        "time.sleep(60)": "act_timeout",
        "os._exit(1)": "killed",
        "bytearray(1 << 30)": "oom",
        "open('big', 'wb').write(bytes(8 << 20))": "file_limit",
        "os.kill(os.getpid(), 9)": "act_error" if tier == "landlock" else "killed",
        threads: "process_limit",
    }
    for act, category in expected.items():
        outcome = slots.play(misbehaving(act=act), tier=tier, limits=limits(act_wall_s=1.0))
        failure = failure_of(outcome)
        assert failure.category == category, failure
        assert slots.play(HONEST, tier=tier).failure is None
