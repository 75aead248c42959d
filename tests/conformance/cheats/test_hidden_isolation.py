"""An agent listens to its machine while hidden episodes of its environment would be played: it hears nothing, as none
is played there before it is gone. With the rule switched off a sibling's agent hears which cases are played.

The channel stands for all that sandbox and jail cannot close: memory shared by processes, which the kernel counts for
the whole machine. They do close this one, so policies and agents have neither here: the rule holds without them, and
the records of who was where hold for every channel.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
import urllib.request
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from attacks.golden_run import GoldenCluster
from attacks.whereabouts import heard_by, met, moments
from programs.signalling_policy import LEVELS
from waiting import TIMEOUT_S, wait_until

from evopolicy_common.records.run_record import RunRecord, decode_run_record
from evopolicy_gateway.run_folder.layout import RunFolder

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.alone]

PROGRAMS = Path(__file__).with_name("programs")
POLICY = PROGRAMS / "signalling_policy.py"
N_HIDDEN = 2
"""Of each hidden split."""
HEARD_S = 20.0
"""How long a listener without the rule is given for one run's hidden cases."""
TRIES = 4
QUIET_S = 6.0
"""How long a listener is given after a submit: much longer than what would be played takes."""


class Listening:
    """`evopolicy run` with an agent that listens."""

    def __init__(self, cluster: GoldenCluster, name: str, process: subprocess.Popen[bytes]) -> None:
        self.root = cluster.root / "runs" / "e" / "toy_line" / name
        self.folder = RunFolder(self.root)
        self.log = cluster.root / f"{name}-log"
        self.process = process

    def wait_for(self, condition: Callable[[], object]) -> None:
        def holds() -> object:
            assert self.process.poll() is None, self.log.read_text()
            return condition()

        wait_until(holds, self.log.read_text)

    @property
    def run(self) -> str:
        """The coordinator's id of the run, while it is open."""
        return self.folder.run

    def listens(self) -> None:
        """Waits until its agent listens."""
        self.wait_for(lambda: heard_by(self.root).get("looks", 0))

    def heard(self) -> list[float]:
        return heard_by(self.root)["heard"]

    def stop(self) -> RunRecord:
        """Its agent ends; the run's record."""
        (self.folder.workspace / "stop").touch()
        return self.record()

    def record(self) -> RunRecord:
        assert self.process.wait(timeout=2 * TIMEOUT_S) == 0, self.log.read_text()
        return decode_run_record(self.folder.run_json.read_bytes())


@contextlib.contextmanager
def listening(
    cluster: GoldenCluster, name: str, n_submits: int, *options: str, agent: str = ""
) -> Iterator[Listening]:
    """`agent`: another one than that which makes `n_submits` and listens."""
    agent = agent or f"command:{sys.executable} {PROGRAMS / 'hearing_agent.py'} {POLICY} {n_submits}"
    words = ("--agent", agent, "--tier", "none", "--credentials", cluster.files["operator"], *options)
    with cluster.command(
        name, *words, "--budget", "8", *(["--jail", "none"] * (agent != "remote"))
    ) as running:
        yield Listening(cluster, name, running)


@contextlib.contextmanager
def cluster_of(root: Path, *options: str) -> Iterator[GoldenCluster]:
    # One slot, so that one pulse is one episode.
    cluster = GoldenCluster(root, *options, slots=1, worker=("--unsandboxed",))
    try:
        yield cluster
    finally:
        cluster.close()


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GoldenCluster]:
    """With the rule switched off."""
    with cluster_of(tmp_path_factory.mktemp("shared"), "--hidden-isolation", "off") as cluster:
        yield cluster


@pytest.fixture(scope="module")
def isolated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GoldenCluster]:
    with cluster_of(tmp_path_factory.mktemp("isolated")) as cluster:
        yield cluster


def pulses(cluster: GoldenCluster, split: str) -> list[int]:
    """What the policy's pulses are high, in MiB, on the cases of a split, as an agent could learn them."""
    starts = [float(np.random.default_rng(case.seed).uniform(-1.0, 1.0)) for case in cluster.cases[split]]
    return [32 + 16 * min(LEVELS - 1, int((start + 1.0) / 2.0 * LEVELS)) for start in starts]


def recognised(heard: list[float], wanted: list[int]) -> int:
    """How many of the wanted pulses are among what was heard, in order, within half a level."""
    found = 0
    for height in heard:
        found += found < len(wanted) and abs(height - wanted[found]) < 8.0
    return found


def hears(run: Listening, wanted: list[int]) -> bool:
    """Whether the listener recognises one of the wanted pulses within a while: other programs' memory can cover
    some."""
    deadline = time.monotonic() + HEARD_S
    while time.monotonic() < deadline:
        if recognised(run.heard(), wanted):
            return True
        time.sleep(0.05)
    return False


def test_without_the_rule_an_agent_hears_none_of_its_hidden_cases(shared: GoldenCluster) -> None:
    """Attack: listens while its own checkpoints are validated. Defence: hidden episodes start when the run has closed,
    with any `--hidden-isolation`."""
    with listening(shared, "own", 1) as run:
        run.listens()
        time.sleep(QUIET_S)
        assert "hidden" not in {moment.what for moment in moments(shared)}
        assert recognised(run.heard(), pulses(shared, "valid")) == 0
        record = run.stop()
    assert record.hidden_isolation == "shared"
    assert len(record.outcome.heldout_returns) == N_HIDDEN


def test_no_hidden_case_is_played_beside_an_agent_that_listens(
    isolated: GoldenCluster,
) -> None:
    """Attack: signals hidden cases through machine-wide counters to an agent on the machine, its own or a
    sibling run's. Defence: no hidden episode is leased on a kernel on which an agent of a related run
    may be alive."""
    with listening(isolated, "own", 1) as run:
        run.listens()
        time.sleep(QUIET_S)
        assert heard_by(run.root)["looks"] > 100
        before = moments(isolated)
        assert "hidden" not in {moment.what for moment in before}
        assert recognised(run.heard(), pulses(isolated, "valid")) == 0
        record = run.stop()
    assert record.hidden_isolation == "exclusive"
    assert len(record.outcome.heldout_returns) == N_HIDDEN
    after = moments(isolated)
    assert sum(moment.what == "hidden" for moment in after) >= 2 * N_HIDDEN
    assert met(isolated, after) == []


def test_without_the_rule_a_sibling_hears_what_another_run_is_scored_on(shared: GoldenCluster) -> None:
    with listening(shared, "sibling", 0) as sibling:
        sibling.listens()
        heard = False
        for attempt in range(TRIES):
            with listening(shared, f"scored{attempt}", 1) as scored:
                scored.listens()
                scored.stop()
            heard = hears(sibling, pulses(shared, "heldout"))
            if heard:
                break
        assert heard
        sibling.process.terminate()


def test_a_run_is_scored_only_after_its_sibling_is_gone(isolated: GoldenCluster) -> None:
    """Attack: signals hidden cases through machine-wide counters to an agent on the machine, its own or a
    sibling run's. Defence: no hidden episode is leased on a kernel on which an agent of a related run
    may be alive."""
    with listening(isolated, "sibling", 1) as sibling:
        sibling.listens()
        with listening(isolated, "scored", 1) as scored:
            scored.listens()
            # The agent of the run that is to be scored is gone, and its sibling goes on listening.
            (scored.folder.workspace / "stop").touch()
            scored.wait_for(lambda: ("close", run_of(scored)) in [(m.what, m.who) for m in moments(isolated)])
            n_before = len(sibling.heard())
            time.sleep(QUIET_S)
            assert recognised(sibling.heard()[n_before:], pulses(isolated, "heldout")) == 0
            assert scored.process.poll() is None
            assert "waiting for" in scored.log.read_text()
            sibling.stop()
            scored.record()
    assert met(isolated, moments(isolated)) == []


def run_of(run: Listening) -> str:
    return run.log.read_text().partition("run ")[2].split()[0]


def test_hidden_episodes_are_not_played_beside_train_episodes_whose_agent_is_elsewhere(
    isolated: GoldenCluster,
) -> None:
    """The policy that plays a hidden case would tell one that plays a train case, whose feedback goes anywhere."""
    kernel = str(uuid.uuid4())
    words = ("--http", "127.0.0.1:0", "--agent-host", kernel)
    with listening(isolated, "far", 0, *words, agent="remote") as far:
        far.wait_for(lambda: far.folder.bearer.exists() and "served at" in far.log.read_text())
        elsewhere = run_of(far)
        (far.folder.system / "policy.py").write_bytes(POLICY.read_bytes())
        with listening(isolated, "near", 1) as near:
            near.listens()
            (near.folder.workspace / "stop").touch()
            near.wait_for(lambda: ("close", run_of(near)) in [(m.what, m.who) for m in moments(isolated)])
            # From now on its hidden episodes want the one slot, as do these train episodes.
            for _ in range(4):
                assert submitted(far, [0, 1]) == "ok"
            near.record()
        far.folder.finish.touch()
        far.record()
    assert met(isolated, moments(isolated), [elsewhere]) == []


def submitted(run: Listening, episodes: list[int]) -> str:
    url = next(line.split()[-1] for line in run.log.read_text().splitlines() if "served at" in line)
    request = urllib.request.Request(
        url,
        data=json.dumps({"env_instances": episodes}).encode(),
        headers={"Authorization": f"Bearer {run.folder.bearer.read_text().strip()}"},
    )
    with urllib.request.urlopen(request, timeout=2 * TIMEOUT_S) as answer:
        return str(json.load(answer)["status"])
