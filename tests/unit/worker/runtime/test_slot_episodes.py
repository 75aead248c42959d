"""A policy's inputs, the record of its episode, and that the same episode is the same bytes."""

from __future__ import annotations

import ctypes
import json
import math
import platform
from pathlib import Path

import numpy as np
import pytest
from slots import HONEST, Slots, acting, category_of, failure_of, make_job, misbehaving, rows

from evopolicy_common.messages.environment import Case
from evopolicy_common.processes.proc import descendants
from evopolicy_worker import environments
from evopolicy_worker.episodes.loop import random_actions
from evopolicy_worker.sandbox.inside.policy_server import reset_floats
from evopolicy_worker.sandbox.jail import ENVIRONMENT

TIERS = ("bwrap", "landlock", "none")


@pytest.mark.parametrize("tier", TIERS)
def test_an_honest_policy_plays_the_whole_episode(slots: Slots, tier: str) -> None:
    outcome = slots.play(HONEST, tier=tier)
    played = rows(outcome)
    assert outcome.failure is None
    assert (outcome.index, outcome.length, outcome.truncated, outcome.terminated) == (1, 60, True, False)
    assert len(played) == 60
    assert outcome.episode_return == sum(row.reward for row in played)
    assert outcome.reward_components["reward_distance"] == sum(row.info["reward_distance"] for row in played)
    assert "action_invalid" not in played[0].info
    assert outcome.wall_s > 0
    assert outcome.policy_cpu_s > 0
    line = environments.make("toy/line")
    obs = line.reset(Case(seed=7))
    for row in played:
        assert row.obs.tobytes() == obs.tobytes()
        assert row.action == [float(obs[2] - obs[0])]
        obs, reward, _, _, _ = line.step(line.action_codec.repair(row.action)[0])
        assert reward == row.reward


def test_the_same_episode_gives_the_same_bytes_in_every_slot(slots: Slots) -> None:
    policy = acting(
        "return [random.uniform(-1, 1) * np.random.rand() * self.generator.random()]",
        init="self.generator = np.random.default_rng()",
        reset='print(episode_index, hash("text"))',
        before="import random; import numpy as np",
    )
    first = slots.play(policy)
    again = slots.play(policy)
    other = slots.play(policy, tier="landlock")
    slots.play(HONEST)
    later = slots.play(policy)
    assert first.trajectory == again.trajectory == other.trajectory == later.trajectory is not None
    assert first.stdout == other.stdout == later.stdout
    elsewhere = slots.play(policy, policy_seed=b"another case's..")
    assert rows(elsewhere)[0].action != rows(first)[0].action


def test_a_prepared_slot_has_its_simulators_before_the_first_job(slots: Slots) -> None:
    slot = slots.new()
    slots.run(slot.prepare(["gym/reacher5"]))
    assert slot._process is not None
    maps = [Path("/proc", str(pid), "maps") for pid in descendants(slot._process.pid)]
    assert any("libmujoco" in path.read_text() for path in maps)
    prepared = slots.play(None, slot=slot, env="gym/reacher5")
    assert prepared.trajectory == slots.play(None, env="gym/reacher5").trajectory
    slots.run(slot.close())


def test_unseeded_numpy_generators_of_all_kinds_are_seeded(slots: Slots) -> None:
    policy = acting(
        """
            r = np.random
            return [r.default_rng().random(), r.default_rng().random(), r.RandomState().rand(),
                    r.Generator(r.PCG64()).random(), float(r.SeedSequence().generate_state(1)[0]),
                    random.random(), r.rand()]
        """,
        before="import random; import numpy as np",
    )
    one, two = (rows(slots.play(policy))[0].action for _ in range(2))
    assert one == two
    assert len(set(one)) == 7
    assert rows(slots.play(policy, policy_seed=bytes(16)))[0].action != one


def test_the_policy_gets_spaces_and_env_meta_but_no_case(slots: Slots) -> None:
    policy = acting(
        init="print(json.dumps(spaces))",
        reset="print(json.dumps([episode_index, os.getcwd(), sys.path[0], sorted(os.environ)]))",
        before="import json, os, sys",
    )
    outcome = slots.play(policy)
    built, reset = map(json.loads, outcome.stdout.decode().splitlines())
    description = environments.describe("toy/line")
    assert built[0] == description.obs_space
    assert built[1] == description.action_space
    told = {"obs_storage": "inline", "reward_components": description.reward_texts}
    told |= {"obs_space": description.obs_space, "action_space": description.action_space}
    assert built[2] == make_job().env_meta | told
    assert reset[0] == 1
    assert reset[1] == reset[2] == "/home/policy/system"
    assert reset[3] == sorted({*ENVIRONMENT, "TMPDIR"})


def test_a_policy_may_change_the_spaces_that_it_is_given(slots: Slots) -> None:
    outcome = slots.play(misbehaving(init="[each.clear() for each in spaces]"))
    assert (outcome.failure, outcome.stdout) == (None, b"")


def test_dicts_texts_and_ints_arrive_as_the_space_says(slots: Slots) -> None:
    act = """
        obs["view"][0, 0] = 9  # an observation is the policy's own
        kinds = [type(obs[key]).__name__ for key in obs]
        return [kinds, str(obs["position"].dtype), obs["view"].shape, obs["compass"], obs["steps"]]
    """
    outcome = slots.play(acting(act), env="toy/maze")
    for row in rows(outcome)[:3]:
        kinds, dtype, shape, compass, steps = row.action
        assert kinds == ["ndarray", "str", "ndarray", "int", "ndarray"]
        assert (dtype, shape) == ("int64", [5, 5])
        assert (compass, steps) == (row.obs["compass"], row.obs["steps"])
        assert row.obs["view"][0, 0] != 9
        assert row.info["action_invalid"] is True


@pytest.mark.parametrize("env", ["toy/line", "toy/maze"])
def test_observations_can_be_asked_for_as_lists(slots: Slots, env: str) -> None:
    policy = acting('return {"obs": obs}')
    row = rows(slots.play(policy, env=env, observations="lists"))[0]
    assert row.action["obs"] == row.obs
    assert type(row.obs) in (list, dict)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1.5", 1.5),
        ("[0.25]", [0.25]),
        ("(1, 2.5)", [1, 2.5]),
        ("np.float32(0.5)", np.array(0.5, np.float32)),
        ("np.int64(1)", 1),
        ("np.array([[True]])", np.array([[True]])),
        ("np.array([0.5], '>f8')", np.array([0.5])),
        ("None", None),
        ("2**100", 2**100),
        ("{'a': [np.zeros(2)], 3: b'x'}", {"a": [np.zeros(2)], "3": b"x"}),
        ("object()", "<object>"),
        ("{1}", "<set>"),
        ("float('nan')", math.nan),
        ("'\\ud800'", "\\ud800"),
        ("np.array(['a'])", ["a"]),
        ("np.longdouble(0.5)", np.array(0.5)),
        ("[[]]", [[]]),
        ("[0.5] * 1000", [0.5] * 1000),
        ("np.arange(1000.0)", np.arange(1000.0)),
    ],
)
def test_an_action_is_recorded_as_it_was_returned(slots: Slots, text: str, value: object) -> None:
    outcome = slots.play(acting(f"return {text}", before="import numpy as np"))
    assert outcome.failure is None
    np.testing.assert_equal(rows(outcome)[0].action, value)


def test_without_a_policy_the_actions_are_keyed_and_uniform(slots: Slots) -> None:
    outcome = slots.play(None, policy_seed=b"k" * 16)
    line = environments.make("toy/line")
    rng = random_actions(b"k" * 16)
    for row in rows(outcome):
        assert row.action.tobytes() == line.action_codec.sample(rng).tobytes()
        assert row.info.keys() == {"reward_distance", "reward_effort", "steps"}
    assert (outcome.failure, outcome.stdout, outcome.policy_cpu_s) == (None, b"", 0.0)


def test_a_hidden_episode_leaves_actions_after_repair_and_rewards_only(slots: Slots) -> None:
    policy = HONEST.replace("return [", "return [5.0 + ")
    full, hidden = slots.play(policy), slots.play(policy, record="actions")
    assert [row.reward for row in rows(hidden)] == [row.reward for row in rows(full)]
    assert all(row.action.tolist() == [1.0] for row in rows(hidden))
    assert all(row.obs is None and row.info == {} for row in rows(hidden))
    assert rows(full)[0].action[0] > 1.0


COUNTING = """
    class Policy:
        built = 0

        def __init__(self, *spaces):
            Policy.built += 1
            self.episodes = []

        def reset(self, episode_index):
            self.episodes.append(episode_index)
            print(Policy.built, self.episodes)

        def act(self, obs):
            return [0.0]
"""


def test_with_scope_submit_one_policy_plays_all_episodes(slots: Slots) -> None:
    outcomes = slots.play_all(COUNTING, n=3, first=0, policy_scope="submit")
    assert [outcome.index for outcome in outcomes] == [0, 1, 2]
    assert [outcome.stdout for outcome in outcomes] == [b"1 [0]\n", b"1 [0, 1]\n", b"1 [0, 1, 2]\n"]
    assert all(outcome.policy_cpu_s > 0 for outcome in outcomes)


def test_hidden_evaluation_with_scope_submit_renews_the_policy_as_told(slots: Slots) -> None:
    outcomes = slots.play_all(COUNTING, n=4, first=0, policy_scope="submit", policy_every=2, record="actions")
    printed = [outcome.stdout.decode() for outcome in outcomes]
    assert printed == ["1 [0]\n", "1 [0, 1]\n", "1 [2]\n", "1 [2, 3]\n"]


def test_with_scope_submit_a_raising_policy_stays_and_a_dead_is_rebuilt(slots: Slots) -> None:
    policy = acting(
        'if self.index == 1: raise ValueError("once")\nif self.index == 2: os._exit(3)\nreturn [0.0]',
        init="self.n = 0",
        reset="self.n += 1; self.index = episode_index; print(self.n)",
        before="import os",
    )
    outcomes = slots.play_all(policy, n=4, first=0, policy_scope="submit")
    assert [category_of(outcome) for outcome in outcomes] == [None, "act_error", "killed", None]
    assert [outcome.stdout for outcome in outcomes] == [b"1\n", b"2\n", b"3\n", b"1\n"]


def test_modules_and_data_of_the_bundle_are_there_and_writable(slots: Slots) -> None:
    files: dict[str, str | bytes] = {
        "policy.py": acting(
            init="""
                data = Path("data/weights.bin").read_bytes()
                Path("data/weights.bin").write_bytes(data + b"!")
                Path("/tmp/note").write_text("mine")
                weights = Path("data/weights.bin").read_bytes()
                print(GAIN, policy_server.NAME, weights, Path("/tmp/note").read_text())
            """,
            before="from pathlib import Path; from helpers.gains import GAIN; import policy_server",
        ),
        "helpers/__init__.py": "",
        "helpers/gains.py": "GAIN = 3",
        "policy_server.py": "NAME = 'a module of mine'",
        "data/weights.bin": b"\x00\xff",
    }
    outcome = slots.play(files)
    assert outcome.failure is None
    assert outcome.stdout.decode() == "3 a module of mine b'\\x00\\xff!' mine\n"


def test_threads_and_numpy_work_in_the_sandbox(slots: Slots) -> None:
    imports = """
        import asyncio, concurrent.futures, datetime, hashlib, json, pickle, sqlite3, statistics, tempfile, threading
        import time
        import numpy as np
    """
    init = """
        pool = concurrent.futures.ThreadPoolExecutor(4)
        sums = list(pool.map(lambda k: np.linalg.norm(np.ones((50, 50)) * k), range(8)))
        with tempfile.TemporaryFile() as file:
            np.save(file, np.fft.fft(np.arange(8.0)))
        np.linalg.svd(np.random.rand(30, 30))
        pickle.loads(pickle.dumps(sums))
        time.sleep(0.001)
        print(round(sums[1]), datetime.datetime.now().year > 2000, time.tzname)
    """
    outcome = slots.play(acting(init=init, before=imports))
    assert (outcome.failure, outcome.stdout) == (None, b"50 True ('UTC', 'UTC')\n")


def test_the_c_librarys_threads_can_be_joined(slots: Slots) -> None:
    # Their join waits on a word that is not private to the process, which the filter answers with "look again".
    policy = acting(
        init="""
            libc, thread = ctypes.CDLL(None), ctypes.c_ulong()
            work = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(lambda _: libc.usleep(20000))
            libc.pthread_create(ctypes.byref(thread), None, work, None)
            print(libc.pthread_join(thread, None))
        """,
        before="import ctypes",
    )
    outcome = slots.play(policy)
    assert (outcome.failure, outcome.stdout) == (None, b"0\n")


LOOKING_UP = acting(
    init="""
        frame = sys._getframe(1)
        while frame is not None:
            for name, value in sorted(frame.f_locals.items()):
                plain = isinstance(value, (int, float, str, bytes, list, tuple, dict, type(None)))
                if not name.startswith("__"):
                    print(frame.f_code.co_name, name, value if plain else type(value).__name__)
            frame = frame.f_back
    """,
    before="import sys",
)


def test_what_stands_above_a_policy_tells_nothing_of_those_before(slots: Slots) -> None:
    """How long the last one took, or that there was one."""
    with slots.running() as slot:
        seen = []
        for _ in range(3):
            seen.append(slots.play(LOOKING_UP, slot=slot).stdout)
            slots.play(HONEST, slot=slot)
    assert b"env_meta" in seen[0]
    assert len(set(seen)) == 1


def test_float_settings_are_the_defaults_whatever_was_set_before(slots: Slots) -> None:
    libm = ctypes.CDLL(None)
    upward = 0x800 if platform.machine() == "x86_64" else 0x400000
    third = 1.0 / float("3")
    try:
        assert libm.fesetround(upward) == 0
        assert 1.0 / float("3") > third
        reset_floats()
        assert libm.fegetround() == 0
        assert 1.0 / float("3") == third
    finally:
        libm.fesetround(0)


def test_a_policy_computes_on_one_thread_in_a_fixed_locale(slots: Slots) -> None:
    init = """
        names = "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "PYTHONHASHSEED"
        print([os.environ[name] for name in names], hash("a word"), locale.setlocale(locale.LC_ALL), time.tzname)
        print(ctypes.CDLL(None).fegetround(), 5e-324 * float("1") > 0)
    """
    policy = acting(init=init, before="import ctypes, locale, os, time")
    outputs = {slots.play(policy, slot=slots.slot()).stdout.decode() for _ in range(2)}
    other = slots.new()
    with pytest.MonkeyPatch.context() as patch:
        other_values = {"OMP_NUM_THREADS": "7", "PYTHONHASHSEED": "9", "LC_ALL": "tr_TR", "TZ": "Asia/Tokyo"}
        for name, value in other_values.items():
            patch.setenv(name, value)
        slots.run(other.start())
    outputs.add(slots.play(policy, slot=other).stdout.decode())
    slots.run(other.close())
    (output,) = outputs
    assert output.startswith("['1', '1', '1', '0'] ")
    # Where a system's C library has no C.UTF-8, it is C, and Python reads UTF-8 all the same.
    assert "C.UTF-8 ('UTC', 'UTC')" in output or " C ('UTC', 'UTC')" in output
    assert output.endswith("0 True\n")


def test_an_episode_ends_at_the_jobs_or_the_environments_limit(slots: Slots) -> None:
    for max_steps, length in ((7, 7), (1000, 60), (0, 60)):
        outcome = slots.play(HONEST, max_steps=max_steps)
        played = rows(outcome)
        assert (outcome.length, outcome.truncated) == (length, True)
        assert [row.truncated for row in played] == [False] * (length - 1) + [True]


FAILS_AT_TWO = """
    class Policy:
        def __init__(self, *spaces):
            self.t = 0
        def reset(self, episode_index):
            if episode_index == 3:
                raise ValueError("no episode three")
        def act(self, obs):
            self.t += 1
            if self.t == 3:
                raise ValueError("no step two")
            return [0.5]
"""


def test_a_failed_episode_that_ends_has_one_random_action_after_the_failure(slots: Slots) -> None:
    ended, other = slots.play_all(FAILS_AT_TWO, n=2, policy_scope="submit", failed_episodes="end-submit")
    failure = failure_of(ended)
    assert (failure.category, failure.step_index, ended.length) == ("act_error", 2, 3)
    assert [row.action for row in rows(ended)][:2] == [[0.5], [0.5]]
    assert [row.info.get("policy_failed", False) for row in rows(ended)] == [False, False, True]
    assert ended.episode_return == sum(row.reward for row in rows(ended))
    assert (other.failure, other.length) == (None, 60)
    on = slots.play(FAILS_AT_TWO)
    assert (on.length, rows(on)[2].action) == (60, rows(ended)[2].action)


def test_an_episode_that_fails_in_reset_has_no_step(slots: Slots) -> None:
    (ended,) = slots.play_all(FAILS_AT_TWO, first=3, failed_episodes="end-submit")
    assert (failure_of(ended).category, ended.length, ended.episode_return) == ("reset_error", 0, 0.0)
    assert rows(ended) == []
