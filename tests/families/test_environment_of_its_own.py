"""A family whose packages exclude those installed here: `setup` installs it for real, `check-env` finds nothing, a
policy beats random, and `evolve` plays a whole run with a worker from its virtual environment. Three workers of
different installations play a mixed suite together."""

from __future__ import annotations

import contextlib
import json
import os
import site
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest
from commands import command, record_in, run_dir
from coordinator_harness import Coordinator
from test_parity import differences, named

from evopolicy_common.catalogue import installs, suites
from evopolicy_common.catalogue.installs import MadeEnvironment
from evopolicy_common.records.run_record import decode_run_record
from evopolicy_common.statistics.intervals import over_cases

pytestmark = pytest.mark.families

FAMILY, ENV = "mo_gymnasium", "gymnasium/deep-sea-treasure-v0"
POLICY = Path(__file__).parent / "policies" / ENV.replace("/", "_")
N_CASES = 32
ROOT = Path(__file__).parents[2]
PLAYS = """
import hashlib, json, sys
import numpy as np
from evopolicy_common.messages.environment import Case
from evopolicy_worker.environments import make

env_id, family, folder, n = *sys.argv[1:4], int(sys.argv[4])
sys.path.insert(0, folder)
from policy import Policy

environment = make(env_id)

def play(seed, policy):
    obs, total, rng = environment.reset(Case(seed=seed)), 0.0, np.random.default_rng(seed)
    while True:
        action = environment.action_codec.sample(rng)
        if policy is not None:
            action, invalid = environment.action_codec.repair(policy.act(obs))
            assert not invalid
        step = environment.step(action)
        obs, total = step.obs, total + step.reward
        if step.terminated or step.truncated:
            return total

found = []
for k in range(n):
    seed = int.from_bytes(hashlib.sha256(f"proof of life {family} {k}".encode()).digest()[:4], "big") >> 1
    policy = Policy(environment.description.obs_space, environment.description.action_space, {})
    policy.reset(0)
    found.append([play(seed, policy), play(seed, None)])
print(json.dumps(found))
"""


def from_a_wheel(folder: Path) -> Path:
    """The `evopolicy-worker` of a virtual environment in which a wheel is installed: no clone is near. What it requires
    is read from this one."""
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder / "venv")], check=True)
    (packages,) = (folder / "venv" / "lib").glob("python3*/site-packages")
    (packages / "third_party.pth").write_text("\n".join(site.getsitepackages()) + "\n")
    (wheel,) = folder.glob("*.whl")
    install = ["-m", "pip", "install", "-q", "--no-deps", "--no-index", "--ignore-installed", str(wheel)]
    subprocess.run([str(folder / "venv" / "bin" / "python"), *install], check=True, capture_output=True)
    return folder / "venv" / "bin" / "evopolicy-worker"


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """`evopolicy-worker` of a wheel; what it sets up is found by local commands."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(installs.FOLDER_VARIABLE, str(tmp_path_factory.mktemp("installs")))
        yield from_a_wheel(tmp_path_factory.mktemp("wheel"))


def set_up(program: Path, family: str) -> MadeEnvironment:
    """The virtual environment that `setup` makes."""
    done = subprocess.run(
        [str(program), "setup", family],
        capture_output=True,
        text=True,
        check=False,
        cwd=program.parent,
        env=dict(os.environ),
    )
    assert done.returncode == 0, done.stderr
    assert "next: " in done.stdout
    (found,) = (each for each in installs.made() if each.families == (family,))
    return found


@pytest.fixture(scope="module")
def made(program: Path) -> MadeEnvironment:
    """The virtual environment of the family that excludes others."""
    return set_up(program, FAMILY)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_its_packages_are_those_that_the_installation_here_excludes(made: MadeEnvironment) -> None:
    assert not installs.is_here(FAMILY)
    listed = subprocess.run(
        [made.python, "-m", "pip", "list", "--format", "json"], capture_output=True, text=True, check=True
    ).stdout
    versions = {each["name"].lower(): each["version"] for each in json.loads(listed)}
    assert versions["highway-env"].startswith("1.11")
    assert "pygame" in versions
    (evopolicy,) = (Path(made.folder) / "lib").glob("python3*/site-packages/evopolicy_worker")
    assert (evopolicy.parent / "evopolicy_gateway" / "constraints.txt").is_file()
    assert "pygame-ce" not in versions
    subprocess.run([made.python, "-m", "pip", "check"], check=True, capture_output=True)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_check_env_finds_nothing_in_a_few_of_its_environments(made: MadeEnvironment) -> None:
    """Asked here, where CartPole is played."""
    ids = [ENV, "gymnasium/minecart-v0", "gymnasium/mo-hopper-v5", "gymnasium/CartPole-v1"]
    program = [sys.executable, "-P", "-m", "evopolicy_worker.cli", "check-env", *ids]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    for each in ids:
        assert f"{each}: ok" in done.stderr


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_every_text_is_whole_and_has_nothing_of_a_library(made: MadeEnvironment) -> None:
    checks = ROOT / "tests" / "conformance" / "environments" / "text_checks.py"
    program = [made.python, str(checks), *suites()[FAMILY].environments]
    helpers = dict(os.environ, PYTHONPATH=str(ROOT / "tests" / "support"))
    done = subprocess.run(program, capture_output=True, text=True, check=False, env=helpers)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == {}


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_sample_is_played_as_its_library_plays_it(made: MadeEnvironment, tmp_path: Path) -> None:
    found = differences(made.python, FAMILY, tmp_path)
    assert found == dict.fromkeys(named(FAMILY), "")


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_policy_beats_random_on_cases_drawn_by_the_familys_name(made: MadeEnvironment) -> None:
    program = [made.python, "-P", "-c", PLAYS, ENV, FAMILY, str(POLICY), str(N_CASES)]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    ours, random = np.array(json.loads(done.stdout.splitlines()[-1])).T
    better = over_cases(ours - random, (ours, random))
    assert better.low is not None
    assert better.low > 0, f"{ours.mean()} beside {random.mean()}"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_evolve_plays_a_whole_run_with_a_worker_from_it(tmp_path: Path, made: MadeEnvironment) -> None:
    small = ["--budget", "4", "--validation", "2", "--heldout", "2", "--video", "all"]
    with command(tmp_path, "local", "--env", ENV, "--agent", "evolve", "--exp-id", "t", *small) as running:
        code, _, err = running.finish()
    assert code == 0, err
    folder = run_dir(tmp_path, env=ENV.replace("/", "_"))
    record = record_in(folder)
    assert record.outcome.status == "completed"
    assert len(record.outcome.heldout_returns) == 2
    episodes = [each.parent for each in (folder / "workspace" / "feedback").rglob("trajectory.jsonl")]
    assert len(episodes) == 4
    for each in episodes:
        assert (each / "video.mp4").read_bytes()[4:8] == b"ftyp"
        (row, *_) = (each / "trajectory.jsonl").read_text().splitlines()
        info = json.loads(row)["info"]
        assert set(info["rewards"]) == {"treasure", "time"}
        assert info["reward_vector"] == list(info["rewards"].values())


MIXED = """
name = "mixed"
environments = [{ids}]
[defaults]
budget = 4
validation = 2
heldout = 2
[parallel]
machine = 1
[[agents]]
name = "evolve"
agent = "evolve"
"""


@contextlib.contextmanager
def workers(coordinator: Coordinator, offered: Mapping[str, str]) -> Iterator[None]:
    """A worker of each interpreter, which offers one environment."""
    options = ["--slots", "1", "--grace", "1", "--credentials", coordinator.ready["credentials"]["worker"]]
    started = []
    with coordinator.log.open("ab") as log:
        for python, env_id in offered.items():
            program = [python, "-P", "-m", "evopolicy_worker.cli", "--env", env_id, *options]
            started.append(subprocess.Popen(program, stdout=log, stderr=log))
    try:
        yield
    finally:
        for each in started:
            each.terminate()
        for each in started:
            each.wait(timeout=60)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_each_run_of_a_mixed_suite_names_its_workers_installation(
    tmp_path: Path, program: Path, made: MadeEnvironment
) -> None:
    third = set_up(program, "minigrid")
    offered = {
        sys.executable: "gymnasium/CartPole-v1",
        made.python: ENV,
        third.python: "gymnasium/MiniGrid-Empty-5x5-v0",
    }
    asks = "from evopolicy_common.catalogue import installs; print(installs.own())"
    names = {
        env_id: subprocess.run(
            [python, "-P", "-c", asks], capture_output=True, text=True, check=True
        ).stdout.strip()
        for python, env_id in offered.items()
    }
    assert [name.partition("@")[0] for name in names.values()] == ["base", FAMILY, "minigrid"]
    assert len({name.partition("@")[2] for name in names.values()}) == 3
    (tmp_path / "mixed.toml").write_text(
        MIXED.format(ids=", ".join(f'"{each}"' for each in offered.values()))
    )
    # Runs of one machine wait for each other's agents otherwise.
    coordinator = Coordinator(tmp_path / "state", "--hidden-isolation", "off")
    try:
        with (
            workers(coordinator, offered),
            command(
                tmp_path, "suite", "mixed.toml", "--credentials", coordinator.ready["credentials"]["operator"]
            ) as running,
        ):
            code, _, err = running.finish(600)
    finally:
        coordinator.stop()
    assert code == 0, err + coordinator.log.read_text()
    records = [decode_run_record(each.read_bytes()) for each in (tmp_path / "runs").rglob("run.json")]
    assert {each.env: each.versions.installations for each in records} == {
        env_id: (name,) for env_id, name in names.items()
    }
    assert all(each.outcome.status == "completed" for each in records)
    assert "mo-gymnasium" in next(each for each in records if each.env == ENV).versions.fingerprint
