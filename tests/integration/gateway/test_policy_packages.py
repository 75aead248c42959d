"""A run whose policies may import scipy: they have it and numpy, no simulator, and its version is in the fingerprint.

What plays the run's policies again gives them the same packages.
"""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path

import pytest
from commands import STILL, agent, ended, played_here, record_in, run_dir

import evopolicy as evp
from evopolicy_common.records.run_record import RunRecord

pytestmark = pytest.mark.system

POLICY = """
import os
import scipy.optimize

class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        shown = {name.partition(".")[0] for name in os.listdir("/packages")}
        assert shown == {"numpy", "scipy"}, shown
        for name in ("gymnasium", "mujoco", "minigrid", "evopolicy_worker", "evopolicy_common"):
            try:
                __import__(name)
            except ImportError:
                continue
            raise AssertionError(f"{name} is there")

    def reset(self, episode_index):
        pass

    def act(self, obs):
        minimum = scipy.optimize.minimize_scalar(lambda x: (x - 0.25) ** 2)
        assert abs(minimum.x - 0.25) < 1e-6
        return [float(minimum.x) / 4]
"""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the state `state` and a finished run in `runs`."""
    folder = tmp_path_factory.mktemp("packages")
    (folder / "policy.py").write_text(POLICY)
    code = f"""
open("system/policy.py", "w").write(open({str(folder / "policy.py")!r}).read())
assert "`scipy`" in open("AGENTS.md").read()
answer = submit([0, 1])
assert answer["status"] == "ok", answer
assert answer["policy_failures"] == 0, answer["warning"]
"""
    shown = ("--jail-bind", str(folder / "policy.py"), "--state", "state")
    played_here(folder, agent(folder, code), "--budget", "2", "--policy-package", "scipy", *shown)
    return folder


@pytest.fixture
def record(root: Path) -> RunRecord:
    return record_in(run_dir(root))


def test_policies_import_the_runs_packages_and_nothing_beside_them(record: RunRecord) -> None:
    assert record.outcome.status == "completed"
    assert record.outcome.auxiliary["policy_failures"]["heldout"] == 0
    assert record.versions.fingerprint["policy:scipy"] == version("scipy")


def test_verify_plays_the_policies_with_their_packages(root: Path) -> None:
    out, _ = ended(root, "verify", str(run_dir(root)), "--local", "--state", "state", "--json")
    report = json.loads(out)
    assert (report["policy_episodes"], report["policy_differences"]) == (2, [])
    assert report["fingerprint_differences"] == []


def test_a_rescore_plays_the_checkpoint_with_its_packages(root: Path) -> None:
    ended(root, "rescore", "runs", "--cases", "2", "--local", "--state", "state")
    (played,) = json.loads((run_dir(root) / "rescore/cases-2.json").read_text())["checkpoints"]
    assert played.get("failures", {}) == {}


def test_a_checkpoint_is_tried_with_its_runs_or_the_named_packages(root: Path, record: RunRecord) -> None:
    checkpoint = next((run_dir(root) / "checkpoints").iterdir())
    where = ("--env", "toy/line", "--cases", "0", "--fresh", "--slots", "1")
    ended(root, "try", str(checkpoint), *where)
    out, _ = ended(root, "try", str(root), *where, ends=1)
    assert "No module named 'scipy'" in out
    _, err = ended(root, "try", str(root), *where, "--policy-package", "no-such-package", ends=2)
    assert "package 'no-such-package' is not installed here; install it with" in err
    ended(root, "try", STILL, *where, "--policy-package", "scipy")


def test_the_python_package_takes_them_too(root: Path) -> None:
    with evp.Cluster.local(slots=1, fresh=True, policy_packages=("scipy",)) as cluster:
        results = cluster.evaluate(root, env="toy/line", cases=[0], progress=False)
    assert results[0].failure is None
    with pytest.raises(evp.ConfigError, match="give a sequence of names"):
        evp.Cluster.local(policy_packages="scipy")
