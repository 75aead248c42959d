"""Policies of the newest published form, `make_policy(context)`, play unchanged in a slot."""

from __future__ import annotations

import json
import sys
import textwrap

import pytest
from slots import Slots, acting, category_of, failure_of, rows

NEWEST = """
    import json
    import struct

    from evopolicygym.policy import POLICY_ABI_VERSION, Policy, PolicyContext, TensorValue, copy_policy_value

    class Controller:
        def __init__(self, context: PolicyContext) -> None:
            self.gain = 1.0
            self.n = 0
            seed = context.policy_seed
            assert 0 <= seed < 1 << 64 and type(seed) is int
            assert context.environment_parameters == {}
            print(json.dumps([POLICY_ABI_VERSION, context.observation_space, context.action_space,
                              dict(context.metadata), seed]))

        def act(self, observation: TensorValue) -> list[float]:
            assert (observation.dtype, observation.shape) == ("float32", (3,)), observation
            assert copy_policy_value(observation) == observation
            position, _, target = struct.unpack("<3f", observation.data)
            self.n += 1
            return [self.gain * (target - position)]

    def make_policy(context: PolicyContext) -> Policy:
        return Controller(context)
"""
EARLIER = acting("return [float(obs[2]) - float(obs[0])]", before="import numpy as np")


def test_a_policy_of_the_newest_form_plays_as_an_earlier_one(slots: Slots) -> None:
    newest, earlier = slots.play(NEWEST), slots.play(EARLIER)
    assert newest.failure is None
    assert [row.action for row in rows(newest)] == [row.action for row in rows(earlier)]
    version, obs_space, action_space, metadata, _ = json.loads(newest.stdout)
    assert (version, obs_space["type"], action_space["shape"]) == ("policy/v2", "Box", [1])
    assert (metadata["env"], metadata["max_episode_steps"]) == ("toy/line", 60)
    assert not {"obs_space", "action_space"} & metadata.keys()


def test_each_episode_has_a_new_policy_and_seed_with_scope_submit_too(slots: Slots) -> None:
    outcomes = slots.play_all(NEWEST, first=0, n=3, policy_scope="submit")
    assert [outcome.failure for outcome in outcomes] == [None] * 3
    assert len({json.loads(outcome.stdout)[-1] for outcome in outcomes}) == 3


def test_observations_as_lists_stay_lists_and_tensors_are_actions(slots: Slots) -> None:
    policy = """
        import struct
        from evopolicygym.policy import TensorValue
        class Policy:
            def act(self, observation):
                assert type(observation) is list and type(observation[0]) is float
                return TensorValue("float64", (1,), struct.pack("<d", 0.25))
        def make_policy(context):
            return Policy()
    """
    outcome = slots.play(policy, observations="lists")
    assert outcome.failure is None
    assert float(rows(outcome)[0].action[0]) == 0.25


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        ("np.zeros(1)", "TypeError"),
        ("[np.float64(0.0)]", "TypeError"),
        ("[float('inf')]", "ValueError"),
        ("TensorValue('float64', (2,), bytes(8))", "ValueError"),
        ("TensorValue('complex64', (1,), bytes(8))", "ValueError"),
    ],
)
def test_an_action_that_the_published_software_refuses_is_a_failure(
    slots: Slots, returned: str, message: str
) -> None:
    policy = f"""
        import numpy as np
        from evopolicygym.policy import TensorValue
        class P:
            def act(self, observation):
                return {returned}
        def make_policy(context):
            return P()
    """
    outcome = slots.play(policy)
    failure = failure_of(outcome)
    assert (failure.category, failure.step_index) == ("act_error", 0)
    assert failure.message.startswith(message)
    if "TensorValue" not in returned:
        # Found in what the policy returned: none of the sandbox's own lines are in the traceback.
        assert "programs.py" not in outcome.failure.traceback


def test_a_fault_in_make_policy_is_an_init_error(slots: Slots) -> None:
    failed = slots.play("def make_policy(context):\n    return context.nothing\n", first=0)
    assert category_of(failed) == "init_error"
    without = slots.play("def make_policy(context):\n    return object()\n", first=0)
    failure = failure_of(without)
    assert (failure.category, "act" in failure.message) == ("init_error", True)
    helper = slots.play(EARLIER.replace("import numpy as np", "def make_policy(context): raise ValueError"))
    assert helper.failure is None


def test_a_missing_environment_parameter_is_named(slots: Slots) -> None:
    policy = "def make_policy(context):\n    return context.environment_parameters['gravity']\n"
    failed = slots.play(policy, first=0)
    assert category_of(failed) == "init_error"
    failure = failure_of(failed)
    assert "there is no environment parameter 'gravity'" in failure.message
    assert "Gymnasium's defaults" in failure.message


@pytest.mark.skipif(
    sys.version_info >= (3, 12), reason="Python 3.12 reads it: play the tests with an earlier one"
)
@pytest.mark.parametrize("line", ["type Number = float", "from typing import override"])
def test_code_for_a_newer_python_names_the_workers(slots: Slots, line: str) -> None:
    failed = slots.play(f"{line}\n{textwrap.dedent(NEWEST)}", first=0)
    assert failure_of(failed).category == "import_error"
    own = f"this worker has Python {sys.version_info[0]}.{sys.version_info[1]}"
    assert failed.failure.message.endswith(f"({own}; policies of this form are written for Python 3.12)")
    earlier = slots.play(f"{line}\n{EARLIER}", first=0)
    assert "3.12" not in failure_of(earlier).message


def test_a_bundles_own_module_of_that_name_comes_first(slots: Slots) -> None:
    files: dict[str, str | bytes] = {
        "policy.py": "from evopolicygym.policy import MINE\n" + textwrap.dedent(EARLIER),
        "evopolicygym/__init__.py": "",
        "evopolicygym/policy.py": "MINE = 1\n",
    }
    assert slots.play(files).failure is None
