"""The worker's supervisor against a real coordinator process, with slots that answer by script.

The slots are the tests' own so that every way in which a slot can end a job is met; `tests/faults` has the real ones.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest
from coordinator_harness import (
    FINGERPRINT,
    LINE,
    Coordinator,
    OperatorClient,
    bundle_of,
    comparable,
    gateway_of,
    operator_of,
    play,
    run,
)
from typer import Typer
from typer.testing import CliRunner

from evopolicy_common.errors import PartFailedError, SandboxError, SlotDiedError, WorkerError
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, Job, Tier
from evopolicy_common.messages.status import WorkerStatus
from evopolicy_common.records.blobs import digest_of
from evopolicy_common.wire import codec
from evopolicy_common.wire.requests import Requester
from evopolicy_common.wire.transport import connect
from evopolicy_coordinator.cli.envs import app as envs_app
from evopolicy_coordinator.cli.status import status_app
from evopolicy_worker import capabilities, outbox, supervisor
from evopolicy_worker.capabilities import Capabilities
from evopolicy_worker.slot_protocol.begun import HandedBack
from evopolicy_worker.supervisor import Supervisor, WorkerOptions

pytestmark = pytest.mark.slow


class ScriptedSlot:
    """Plays as the harness's `play` does, after what `script` does with the job; `dress` changes each outcome."""

    def __init__(
        self,
        script: Callable[[ScriptedSlot, Job], Awaitable[None]],
        dress: Callable[[EpisodeOutcome], EpisodeOutcome],
    ) -> None:
        self.script = script
        self.dress = dress
        self.started = 0
        self.prepared: tuple[str, ...] | None = None
        self.stopped = asyncio.Event()
        self.begun: HandedBack | None = None

    async def start(self) -> None:
        self.started += 1

    async def prepare(self, env_ids: Sequence[str]) -> None:
        await self.start()
        self.prepared = tuple(env_ids)

    async def play_job(
        self, job: Job, bundle: Path | None, on_progress: Callable[[int, int], None]
    ) -> tuple[EpisodeOutcome, ...]:
        assert (bundle is None) == (job.bundle is None)
        assert bundle is None or (bundle / "policy.py").read_text()
        self.stopped.clear()
        await self.script(self, job)
        on_progress(1, 10)
        if self.stopped.is_set():
            return ()
        return tuple(self.dress(play(job, spec)) for spec in job.episodes)

    async def cancel(self) -> None:
        self.stopped.set()

    async def close(self) -> None:
        pass


def large(outcome: EpisodeOutcome) -> EpisodeOutcome:
    """The outcome with a trajectory that is too big to travel inline."""
    assert outcome.trajectory is not None
    data = (outcome.trajectory.inline or b"") * 8000
    assert len(data) > codec.INLINE_BYTES
    blob = BlobRef(digest=digest_of(data), size=len(data), inline=data)
    return msgspec.structs.replace(outcome, trajectory=blob)


def make_data(folder: Path) -> None:
    """Split files for `toy/line`, so that two coordinators play the same cases."""
    (folder / "toy_line").mkdir(parents=True)
    for number, (split, n) in enumerate((("train", 16), ("valid", 16), ("heldout", 32))):
        cases = [{"seed": 1000 * number + i} for i in range(n)]
        (folder / "toy_line" / f"{split}.json").write_text(
            json.dumps({"env": "toy/line", "split": split, "cases": cases})
        )


def talkative(outcome: EpisodeOutcome) -> EpisodeOutcome:
    """The outcome of a policy that prints whatever is kept of it."""
    return msgspec.structs.replace(outcome, stdout=b"o" * 65536, stderr=b"e" * 65536)


async def at_once(slot: ScriptedSlot, job: Job) -> None:
    await asyncio.sleep(0)


@contextlib.asynccontextmanager
async def supervising(
    coordinator: Coordinator,
    scratch: Path,
    script: Callable[[ScriptedSlot, Job], Awaitable[None]] = at_once,
    *,
    name: str = "w-1",
    slots: int = 2,
    grace_s: float = 5.0,
    dress: Callable[[EpisodeOutcome], EpisodeOutcome] = large,
    kind: type[ScriptedSlot] = ScriptedSlot,
    able: Capabilities | None = None,
) -> AsyncIterator[Supervisor]:
    """A supervisor that works in the background and is drained at the end. `able`: else every job can be played."""
    options = WorkerOptions(
        name=name,
        slots=slots,
        fingerprint=FINGERPRINT,
        host="test",
        boot_id=f"kernel-of-{name}",
        scratch=scratch / name,
        grace_s=grace_s,
    )
    able = able or Capabilities(("bwrap",), (LINE,))
    async with connect(coordinator.credentials("worker")) as link:
        worker = Supervisor(link, options, able, lambda index, tier: kind(script, dress))
        task = asyncio.create_task(worker.run())
        try:
            yield worker
        finally:
            worker.drain()
            await asyncio.wait_for(task, 30)


async def whole_run(coordinator: Coordinator, key: str = "run") -> dict[str, Any]:
    """Two submits, closed and finished; what must not depend on the workers."""
    async with operator_of(coordinator) as operator:
        created = await operator.create(key=key, n_validation=3, n_heldout=4)
        async with gateway_of(coordinator, created) as gateway:
            for number in range(2):
                await gateway.submit(bundle_of(f"policy {number}"), tuple(range(8)), f"k{number}")
                await gateway.results(number)
            await gateway.close()
        return comparable(await operator.finished(created.run))


async def test_a_whole_run_goes_through_the_supervisor(coordinator: Coordinator, tmp_path: Path) -> None:
    async with supervising(coordinator, tmp_path) as worker:
        finished = await whole_run(coordinator)
        assert finished["status"] == "completed"
        assert len(finished["heldout_returns"]) == 4
        assert finished["nondeterministic_results"] == 0
        assert worker.jobs_done == 30  # 16 train, 2 × 3 validation, 4 held-out, 4 random


async def until_told(operator: OperatorClient, reason: str, told: Callable[[WorkerStatus], bool]) -> str:
    """Why the run waits, once that contains `reason` and the only worker is shown as `told` wants."""
    async with asyncio.timeout(30):
        while True:
            status = await operator.status()
            waits = [run.waits_for for run in status.runs if reason in run.waits_for]
            if waits and told(status.workers[0]):
                return waits[0]
            await asyncio.sleep(0.05)


async def shown_by(coordinator: Coordinator, app: Typer) -> str:
    """The output of a command for operators, on one line."""
    arguments = ["--credentials", coordinator.ready["credentials"]["operator"]]
    shown = await asyncio.to_thread(CliRunner().invoke, app, arguments)
    return shown.stdout.replace("\n", " ")


async def test_an_environment_that_failed_is_told_and_tried_again(
    coordinator: Coordinator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capabilities, "RETRY_PAUSE_S", 0.05)
    works, tried = asyncio.Event(), asyncio.Event()
    again = "step 4: it raised KeyError again"

    async def describe(wanted: Sequence[str]) -> tuple[tuple[EnvironmentDescription, ...], dict[str, str]]:
        assert wanted == ("toy/line",)
        tried.set()
        return ((LINE,), {}) if works.is_set() else ((), {"toy/line": again})

    failed = {"toy/line": "step 3: it raised KeyError"}
    able = Capabilities(("bwrap",), (), failed_environments=failed, describe=describe)
    async with supervising(coordinator, tmp_path, able=able), operator_of(coordinator) as operator:
        played = asyncio.create_task(whole_run(coordinator, "waits"))
        await tried.wait()
        waits = await until_told(operator, again, lambda w: w.failed_environments == {"toy/line": again})
        assert f"it failed on w-1: {again}" in waits
        for app in (status_app, envs_app):
            assert again in await shown_by(coordinator, app)
        works.set()
        assert (await played)["status"] == "completed"
        (worker,) = (await operator.status()).workers
        assert (worker.environments, worker.failed_environments) == (("toy/line",), {})


async def test_a_tier_that_failed_once_is_told_and_tried_again(
    coordinator: Coordinator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capabilities, "RETRY_PAUSE_S", 0.05)
    works, probed = asyncio.Event(), asyncio.Event()

    async def probe(tier: Tier) -> None:
        probed.set()
        if not works.is_set():
            raise SandboxError(f"{tier}: still no namespaces")

    able = Capabilities(("landlock",), (LINE,), missing_tiers={"bwrap": "no namespaces"}, probe=probe)
    again = "bwrap: still no namespaces"
    async with supervising(coordinator, tmp_path, able=able), operator_of(coordinator) as operator:
        played = asyncio.create_task(whole_run(coordinator, "waits"))
        await probed.wait()
        waits = await until_told(
            operator, "tier bwrap", lambda w: (w.tiers, w.missing_tiers) == (("landlock",), {"bwrap": again})
        )
        assert f"w-1 has no sandbox tier bwrap: {again}" in await shown_by(coordinator, status_app)
        assert f"does not work on w-1: {again}" in waits
        works.set()
        assert (await played)["status"] == "completed"
        (worker,) = (await operator.status()).workers
        assert (worker.tiers, worker.missing_tiers) == (("bwrap", "landlock"), {})


async def test_a_slot_that_dies_or_fails_changes_no_result(tmp_path: Path) -> None:
    died: Counter[str] = Counter()
    failed: set[str] = set()

    async def trouble(slot: ScriptedSlot, job: Job) -> None:
        # More often than would quarantine a bundle, were it the bundle's doing.
        if job.episodes[0].index % 4 == 1 and died[job.job_id] < (5 if "/train/1" in job.job_id else 1):
            died[job.job_id] += 1
            raise SlotDiedError("environment process ended with status -9")
        if job.episodes[0].index % 4 == 2 and job.job_id not in failed:
            failed.add(job.job_id)
            raise SandboxError("no space for the policy's copy")

    make_data(tmp_path / "data")

    results = []
    for name, script in (("calm", at_once), ("troubled", trouble)):
        (tmp_path / name).mkdir()
        coordinator = Coordinator(tmp_path / name / "state", "--data", str(tmp_path / "data"))
        try:
            async with supervising(coordinator, tmp_path / name, script):
                results.append(await whole_run(coordinator))
        finally:
            coordinator.stop()
    assert died
    assert failed
    assert results[0] == results[1]


async def test_slots_are_prepared_before_there_is_work(coordinator: Coordinator, tmp_path: Path) -> None:
    made: list[ScriptedSlot] = []

    class Watched(ScriptedSlot):
        async def prepare(self, env_ids: Sequence[str]) -> None:
            made.append(self)
            await super().prepare(env_ids)

    async with supervising(coordinator, tmp_path, kind=Watched):
        while [slot.prepared for slot in made] != [("toy/line",)] * 2:
            await asyncio.sleep(0.01)
        await whole_run(coordinator)
    assert [slot.started for slot in made] == [1, 1]


async def test_an_unprepared_slot_is_started_again_for_its_first_lease(
    coordinator: Coordinator, tmp_path: Path
) -> None:
    class Unprepared(ScriptedSlot):
        async def prepare(self, env_ids: Sequence[str]) -> None:
            raise WorkerError("not yet")

    async with supervising(coordinator, tmp_path, kind=Unprepared):
        assert (await whole_run(coordinator))["status"] == "completed"


def test_a_restarted_coordinator_is_registered_with_again(tmp_path: Path) -> None:
    coordinator = Coordinator(tmp_path / "state")
    reached = asyncio.Event()
    go_on = asyncio.Event()

    async def wait(slot: ScriptedSlot, job: Job) -> None:
        reached.set()
        await go_on.wait()

    async def scenario() -> None:
        nonlocal coordinator
        async with supervising(coordinator, tmp_path, wait):
            run_task = asyncio.create_task(whole_run(coordinator))
            await reached.wait()
            coordinator.kill()
            coordinator = Coordinator(tmp_path / "state")
            go_on.set()
            assert (await run_task)["status"] == "completed"

    try:
        run(scenario)
    finally:
        coordinator.stop()


async def leaves_in_the_middle(
    coordinator: Coordinator,
    tmp_path: Path,
    script: Callable[[ScriptedSlot, Job], Awaitable[None]],
    reached: asyncio.Event,
    **options: float,
) -> None:
    """A worker is drained once its slot has `reached` the middle of a run, and another plays that run to its end."""
    async with supervising(coordinator, tmp_path, script, name="leaver", **options) as leaver:
        run_task = asyncio.create_task(whole_run(coordinator))
        await reached.wait()
        leaver.drain()
    async with supervising(coordinator, tmp_path, name="stayer"):
        assert (await run_task)["status"] == "completed"


def test_a_drained_worker_hands_back_what_it_has_not_played(coordinator: Coordinator, tmp_path: Path) -> None:
    reached = asyncio.Event()

    async def stuck(slot: ScriptedSlot, job: Job) -> None:
        reached.set()
        await slot.stopped.wait()
        raise SandboxError("cancelled")

    run(lambda: leaves_in_the_middle(coordinator, tmp_path, stuck, reached))


async def test_a_submit_of_128_talkative_episodes_is_handed_in_and_blocks_nothing(
    coordinator: Coordinator, tmp_path: Path
) -> None:
    """Attack: prints so much that the worker's results exceed a message. Defence: large outcomes are sent
    as blobs; a result that is refused for good is settled and blocks nothing."""
    async with supervising(coordinator, tmp_path, dress=talkative), operator_of(coordinator) as operator:
        created = await operator.create(policy_scope="submit", budget=128, n_validation=2, n_heldout=2)
        async with gateway_of(coordinator, created) as gateway:
            await gateway.submit(bundle_of("loud"), tuple(range(64)) * 2, "k")
            episodes, done = await gateway.results(0)
            await gateway.close()
        assert (done.status, len(episodes)) == ("ok", 128)
        assert {(len(each.stdout), len(each.stderr)) for each in episodes} == {(65536, 65536)}
        finished = await operator.finished(created.run)
        assert (finished.status, finished.infrastructure_retries) == ("completed", 0)


async def test_what_the_coordinator_has_lost_is_sent_again(
    coordinator: Coordinator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost: list[str] = []
    real = Requester.upload

    async def upload(self: Requester[Any], sender: str, token: str, digest: str, data: bytes) -> None:
        await real(self, sender, token, digest, data)
        blob = coordinator.state / "blobs" / digest[:2] / digest
        if sender == "w-1" and len(lost) < 3 and blob.exists():
            lost.append(digest)
            blob.unlink()

    monkeypatch.setattr(Requester, "upload", upload)
    monkeypatch.setattr(outbox, "PAUSE_S", 0.05)

    async with supervising(coordinator, tmp_path):
        assert (await whole_run(coordinator))["status"] == "completed"
    assert len(lost) == 3


async def test_results_are_batched_while_jobs_wait_but_not_the_last(
    coordinator: Coordinator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As good as for ever: a run that ends has not waited for the time to pass.
    monkeypatch.setattr(outbox, "LINGER_S", 3600.0)
    reports: list[int] = []
    real = Requester.until_answered

    async def until_answered(
        self: Requester[Any], verb: str, message: Any, *rest: Any, **options: Any
    ) -> Any:
        if verb == "done":
            reports.append(len(message.results))
        return await real(self, verb, message, *rest, **options)

    monkeypatch.setattr(Requester, "until_answered", until_answered)

    async with supervising(coordinator, tmp_path):
        assert (await whole_run(coordinator))["status"] == "completed"
    assert max(reports) > 2


@pytest.mark.parametrize("bulk", [40, 200_000, 2_000_000])
async def test_a_result_that_is_refused_for_good_blocks_no_other(
    coordinator: Coordinator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bulk: int
) -> None:
    monkeypatch.setattr(outbox, "PAUSE_S", 0.05)
    broken: list[int] = []

    def wrong(outcome: EpisodeOutcome) -> EpisodeOutcome:
        """Bytes that are not those of their digest: as a part of the message, as a blob, or as a part of a packed
        blob."""
        if outcome.index in (2, 3) and len(broken) < 4:
            broken.append(outcome.index)
            size = bulk if bulk == 200_000 else 40
            blob = BlobRef(digest=digest_of(b"other"), size=size, inline=bytes(size))
            return msgspec.structs.replace(
                outcome, trajectory=blob, stdout=bytes(bulk if bulk > 200_000 else 0)
            )
        return large(outcome)

    async with supervising(coordinator, tmp_path, dress=wrong), operator_of(coordinator) as operator:
        created = await operator.create(n_validation=1, n_heldout=1)
        async with gateway_of(coordinator, created) as gateway:
            await gateway.submit(bundle_of("policy"), tuple(range(8)), "k")
            episodes, done = await gateway.results(0)
            await gateway.close()
        assert (done.status, len(episodes)) == ("ok", 8)
        finished = await operator.finished(created.run)
        assert finished.status == "completed"
        assert finished.infrastructure_retries == len(broken) == 4


def test_a_slot_that_heeds_nothing_does_not_hold_up_the_workers_end(
    coordinator: Coordinator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "CANCEL_TIMEOUT_S", 0.2)
    reached = asyncio.Event()

    async def deaf(slot: ScriptedSlot, job: Job) -> None:
        reached.set()
        await asyncio.sleep(1000)

    run(lambda: leaves_in_the_middle(coordinator, tmp_path, deaf, reached, grace_s=0.2))


async def test_a_worker_whose_coordinator_is_away_ends_all_the_same(
    coordinator: Coordinator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "WITHDRAW_TIMEOUT_S", 0.2)
    played, come_back = asyncio.Event(), asyncio.Event()

    async def until_it_is_away(slot: ScriptedSlot, job: Job) -> None:
        played.set()
        await come_back.wait()

    async with supervising(coordinator, tmp_path, until_it_is_away, grace_s=0.2) as leaver:
        run_task = asyncio.create_task(whole_run(coordinator))
        await played.wait()
        coordinator.kill()
        come_back.set()
        leaver.drain()
    run_task.cancel()
    await asyncio.gather(run_task, return_exceptions=True)


async def hang(slot: ScriptedSlot, go_on: asyncio.Event) -> None:
    """Until the slot is stopped or may `go_on`."""
    waits = [asyncio.create_task(event.wait()) for event in (slot.stopped, go_on)]
    await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    for wait in waits:
        wait.cancel()


async def test_a_silent_coordinator_stops_hidden_episodes_only(
    coordinator: Coordinator, tmp_path: Path
) -> None:
    stopped: list[str] = []
    playing = asyncio.Event()
    go_on = asyncio.Event()

    async def hang_once(slot: ScriptedSlot, job: Job) -> None:
        if not go_on.is_set() and ("/validation/" in job.job_id or "/random/" in job.job_id):
            playing.set()
            await hang(slot, go_on)
            if slot.stopped.is_set():
                stopped.append(job.job_id)

    async with (
        supervising(coordinator, tmp_path, hang_once, slots=4) as worker,
        operator_of(coordinator) as operator,
    ):
        created = await operator.create(n_validation=2, n_heldout=2)
        async with gateway_of(coordinator, created) as gateway:
            await gateway.submit(bundle_of("policy"), (0,), "k0")
            await gateway.results(0)
            await gateway.close()
        await playing.wait()
        worker._lease_ttl_s = 2.0
        coordinator.process.send_signal(signal.SIGSTOP)
        try:
            async with asyncio.timeout(60.0):
                while len(stopped) < 2:
                    await asyncio.sleep(0.05)
        finally:
            coordinator.process.send_signal(signal.SIGCONT)
        go_on.set()
        finished = await operator.finished(created.run)
    assert sorted(name.rsplit("/", 2)[1] for name in stopped) == ["validation", "validation"]
    assert (finished.status, finished.infrastructure_retries) == ("completed", 0)


@pytest.mark.parametrize(
    ("broken", "part"),
    [
        ("evopolicy_common.wire.transport.Link.ask_blocking", "the heartbeat"),
        ("evopolicy_worker.outbox.Outbox._batch", "reporting"),
    ],
)
def test_a_worker_with_a_failed_part_ends_with_the_reason(
    coordinator: Coordinator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str, part: str
) -> None:
    """Alive, it would lose its leases one after another, or keep what it played, for ever."""

    def bug(*_: object, **__: object) -> object:
        raise LookupError("a bug")

    async def scenario() -> None:
        async with operator_of(coordinator) as operator:
            created = await operator.create(n_validation=1, n_heldout=1)
            async with gateway_of(coordinator, created) as gateway:
                await gateway.submit(bundle_of("policy"), (0, 1), "k")
                async with supervising(coordinator, tmp_path) as worker:
                    while not worker._failed.done():
                        await asyncio.sleep(0.02)

    monkeypatch.setattr(broken, bug)
    with pytest.raises(PartFailedError, match=f"{part} failed: LookupError: a bug"):
        run(scenario)
