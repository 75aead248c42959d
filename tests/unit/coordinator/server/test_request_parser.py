"""Parsed requests: which requests become events, and why the others do not."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rigs.core_rig import describe, fingerprint
from rigs.finished_run import finished
from rigs.service_world import IDENTITY
from rigs.store_rows import blob

from evopolicy_common.catalogue import worlds
from evopolicy_common.errors import ConfigError, ProtocolError, RefusedError
from evopolicy_common.messages import gateway, operator, worker
from evopolicy_common.messages.environment import Case
from evopolicy_common.messages.episode import BlobRef, EpisodeOutcome, PolicyFailure, ResourceLimits
from evopolicy_common.messages.run_settings import PUBLISHED, RunSettings
from evopolicy_common.messages.status import StatusRequest
from evopolicy_common.messages.worker import Message
from evopolicy_common.records.blobs import BlobStore
from evopolicy_common.wire import codec, keys
from evopolicy_coordinator.core.contract.records import JournalRow, RunRow
from evopolicy_coordinator.pki.machines import Machines
from evopolicy_coordinator.server import request_checks
from evopolicy_coordinator.server.definitions import Definitions
from evopolicy_coordinator.server.reader import ServiceReader
from evopolicy_coordinator.server.request_parser import REQUESTS, RequestParser
from evopolicy_coordinator.server.run_requests import RunRequests
from evopolicy_coordinator.server.uploads import Uploads
from evopolicy_coordinator.splits import SplitSource
from evopolicy_coordinator.storage.store import Store

CAPABILITIES = {"r": "capable"}


@pytest.fixture
def blobs(tmp_path: Path) -> BlobStore:
    return BlobStore(tmp_path)


@pytest.fixture
def uploads() -> Uploads:
    return Uploads()


@pytest.fixture
def parser(tmp_path: Path, blobs: BlobStore, uploads: Uploads) -> RequestParser:
    return make_parser(tmp_path, blobs, uploads)


def make_parser(
    state: Path, blobs: BlobStore | None = None, uploads: Uploads | None = None, data: Path | None = None
) -> RequestParser:
    source, blobs = SplitSource(data=data, secret=b"s" * 32), blobs or BlobStore(state)
    uploads = uploads or Uploads()
    reader = ServiceReader(state / "db", blobs, uploads, state)
    runs = RunRequests(reader, blobs, source, allowed_imports=("numpy",), denied_imports=("gymnasium",))
    return RequestParser(IDENTITY, blobs, uploads, runs, Machines(state), Definitions())


def event(parser: RequestParser, key: str, message: Message) -> Any:
    return parser.event(parser.parse(key, codec.encode(message), CAPABILITIES.get), 7, "stimulus")


def refused(parser: RequestParser, key: str, message: Message) -> RefusedError:
    with pytest.raises(RefusedError) as caught:
        event(parser, key, message)
    return caught.value


def submit(**changes: Any) -> gateway.Submit:
    values = {"run": "r", "token": "capable", "key": "k", "env_instances": (0,), "bundle": None, **changes}
    return gateway.Submit(**values)


def create(**settings: Any) -> operator.CreateRun:
    values = {"env": "toy/line", "entry": "e", "model": "m", "exp_id": "x", **settings}
    return operator.CreateRun(token="operate", key="k", settings=RunSettings(**values))


def evaluate(**changes: Any) -> operator.Evaluate:
    values = {"token": "operate", "key": "k", "env": "toy/line", "bundle": None, "split": "train"}
    return operator.Evaluate(**{**values, "cases": None, **changes})


def rescore(row: RunRow, cases: tuple[Case, ...], *indexes: int) -> operator.Rescore:
    wanted = {"run": row.run, "submit_index": 0, "cases": cases, "indexes": indexes}
    return operator.Rescore(token="operate", key="k", **wanted)


def numbers_of(row: RunRow) -> tuple[int, ...]:
    return row.budget, row.min_episodes_per_submit, row.max_episodes_per_submit


SUBMIT = keys.gateway_key("c", "r", "submit")
OPS = keys.operator_key("c", "any")


def test_run_takes_its_numbers_and_cases_from_its_suite(parser: RequestParser) -> None:
    made = event(parser, OPS, create())
    assert numbers_of(made.row) == (128, 1, 128)
    assert (len(made.row.train), len(made.row.validation), len(made.row.heldout)) == (64, 16, 32)
    assert made.row.cases_secret
    assert len(made.row.secret) == 32
    assert keys.valid_name(made.row.run)
    assert (made.row.allowed_imports, made.row.denied_imports) == (("numpy",), ("gymnasium",))
    other = event(parser, OPS, msgspec.structs.replace(create(), key="k2"))
    assert (other.row.train, other.row.split_hashes) == (made.row.train, made.row.split_hashes)
    assert made.row.run != other.row.run
    assert made.row.capability != other.row.capability
    assert made.row.secret != other.row.secret


def test_run_may_ask_for_other_numbers(parser: RequestParser) -> None:
    made = event(parser, OPS, create(budget=8, n_validation=3, n_heldout=4, min_episodes_per_submit=2))
    assert numbers_of(made.row) == (8, 2, 8)
    usual = event(parser, OPS, create())
    assert made.row.validation == usual.row.validation[:3]
    assert made.row.heldout == usual.row.heldout[:4]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"env": "toy/lime"}, "toy/line"),
        ({"budget": 0}, "budget of 0"),
        ({"budget": -1}, "budget of -1"),
        ({"budget": 4, "min_episodes_per_submit": 5}, "submits of 5 to 128"),
        ({"min_episodes_per_submit": 0}, "0 to 128"),
        ({"n_heldout": 0}, "at least one"),
        ({"budget": 20_001}, "20,000"),
        ({"budget": 20_000, "max_episodes_per_submit": 10_001}, "10,000"),
        ({"n_heldout": 10_001}, "10,000"),
        ({"n_validation": 10_001}, "10,000"),
        ({"limits": ResourceLimits(act_wall_s=-1.0)}, "limit act_wall_s is -1.0"),
        ({"limits": ResourceLimits(memory_bytes=0)}, "limit memory_bytes is 0"),
        ({"limits": ResourceLimits(submit_wall_s=1e300)}, "limit submit_wall_s is 1e+300"),
        ({"limits": ResourceLimits(output_bytes=65537)}, "at most 65,536"),
        ({"limits": ResourceLimits(action_bytes=1 << 30)}, "at most 1,048,576"),
        ({"limits": ResourceLimits(memory_bytes=1 << 60)}, "limit memory_bytes"),
    ],
)
def test_run_with_impossible_settings_is_refused(
    parser: RequestParser, settings: dict[str, Any], message: str
) -> None:
    error = refused(parser, OPS, create(**settings))
    assert error.status == "invalid_settings"
    assert message in error.message


def test_a_bounded_agent_report_still_closes_its_run(parser: RequestParser) -> None:
    key = keys.gateway_key("c", "r", "close")
    small = {"turns": 3}
    cut = {"left_out": "300,917 bytes; 262,144 are the limit"}
    for facts, kept in ((small, small), ({"turns": 3, "notes": ["x" * 1000] * 300}, cut)):
        close = gateway.CloseRun(run="r", token="capable", reason="agent_stopped", agent=facts)
        assert event(parser, key, close).message.agent == kept


def test_a_close_reason_fits_into_the_message_of_the_runs_end(parser: RequestParser) -> None:
    close = gateway.CloseRun(run="r", token="capable", reason="x" * (1 << 18))
    made = event(parser, keys.gateway_key("c", "r", "close"), close)
    assert made.message.reason == "x" * 200


def test_a_submits_episodes_fit_into_one_lease_with_policy_scope_submit() -> None:
    cases = [Case(seed=k, options={"map": "x" * 4000}) for k in range(5)]
    request_checks.check_job(cases, 1000)
    with pytest.raises(RefusedError, match="4000 episodes"):
        request_checks.check_job(cases, 4000)


def test_evaluation_plays_the_cases_named(parser: RequestParser) -> None:
    made = event(parser, OPS, evaluate(cases=(5, 0, 5)))
    run = event(parser, OPS, create())
    assert made.row.cases == (run.row.train[5], run.row.train[0], run.row.train[5])
    assert len(event(parser, OPS, evaluate(split="heldout")).row.cases) == 32
    for cases in ((64,), (-1,), ()):
        assert refused(parser, OPS, evaluate(cases=cases)).status == "invalid_env_instance"


def test_submit_needs_its_bundle_stored_or_the_reason_why_there_is_none(
    parser: RequestParser, blobs: BlobStore, uploads: Uploads
) -> None:
    failure = PolicyFailure(category="missing_policy", step_index=None, message="no policy.py")
    assert event(parser, SUBMIT, submit(bundle_error=failure)).message.bundle_error == failure
    assert refused(parser, SUBMIT, submit(bundle="a" * 64)).status == "missing_bundle"
    assert refused(parser, SUBMIT, submit(bundle="../../identity.json")).status == "missing_bundle"
    stored = blobs.put(b"bundle")
    # Stored by another run, it is as if it were not here.
    uploads.note("another", stored)
    assert refused(parser, SUBMIT, submit(bundle=stored)).status == "missing_bundle"
    uploads.note("r", stored)
    assert event(parser, SUBMIT, submit(bundle=stored)).message.bundle == stored
    assert refused(parser, SUBMIT, submit()).status == "bad_message"
    assert refused(parser, SUBMIT, submit(bundle=stored, bundle_error=failure)).status == "bad_message"


def test_override_of_a_runs_class_needs_a_reason(parser: RequestParser) -> None:
    values = {"token": "operate", "run": "r", "fingerprint_class": "c"}
    assert event(parser, OPS, operator.RepinRun(**values, reason="gone")).message.reason == "gone"
    assert refused(parser, OPS, operator.RepinRun(**values, reason=" ")).status == "bad_message"


@pytest.mark.parametrize("key", ["", "k" * 201, "k\0"])
def test_idempotency_key_has_a_length_and_can_be_stored(parser: RequestParser, key: str) -> None:
    """Attack: a gateway's key with a NUL, which PostgreSQL refuses, ends the coordinator at every start.
    Defence: the request is refused."""
    failure = PolicyFailure(category="missing_policy", step_index=None, message="")
    assert refused(parser, SUBMIT, submit(key=key, bundle_error=failure)).status == "bad_message"


def report_results(**blobs_of_outcome: BlobRef) -> worker.ReportResults:
    outcome = EpisodeOutcome(
        index=0, episode_return=1.0, length=1, terminated=True, truncated=False, **blobs_of_outcome
    )
    result = worker.JobResult(lease_id="l", job_id="j", attempt=1, kind="done", episodes=(outcome,))
    return worker.ReportResults(worker="w", session="s", results=(result,))


def test_results_must_hold_or_have_stored_the_blobs_they_name(
    parser: RequestParser, blobs: BlobStore
) -> None:
    key = keys.worker_key("c", "done")
    data = b"trajectory"
    whole = report_results(trajectory=blob(data))
    assert event(parser, key, whole).message == whole
    named = blob(data, inline=False)
    assert refused(parser, key, report_results(trajectory=named)).status == "missing_blob"
    blobs.put(data)
    assert event(parser, key, report_results(trajectory=named)).message == report_results(trajectory=named)
    # Somebody who fetches it relies on the size.
    small = BlobRef(digest=named.digest, size=1)
    assert refused(parser, key, report_results(trajectory=small)).status == "bad_blob"
    wrong = BlobRef(digest=named.digest, size=len(data), inline=b"trajectorY")
    assert refused(parser, key, report_results(video=wrong)).status == "bad_blob"
    assert refused(parser, key, report_results(video=BlobRef(digest="../x", size=1))).status == "missing_blob"


def test_recordings_to_replay_are_stored_with_the_size_that_is_announced(
    parser: RequestParser, blobs: BlobStore
) -> None:
    data = b"trajectory"
    named = blob(data, inline=False)
    asked = evaluate(cases=(0,), replays=(named,), bundle=None)
    assert refused(parser, OPS, asked).status == "missing_blob"
    blobs.put(data)
    assert event(parser, OPS, asked).row.replays == (named,)
    small = BlobRef(digest=named.digest, size=1)
    assert refused(parser, OPS, evaluate(cases=(0,), replays=(small,), bundle=None)).status == "bad_blob"


def test_an_oversized_blob_is_never_read(
    parser: RequestParser, blobs: BlobStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(codec, "MAX_PACKED_BYTES", 1000)
    digest = blobs.put(bytes(1001))
    monkeypatch.setattr(blobs, "read_blob", None)
    result = worker.JobResult(lease_id="l", job_id="j", attempt=1, kind="done")
    for size in (1001, 1000):  # as it is, and as a liar says
        ref = BlobRef(digest=digest, size=size)
        for part in ("packed", "begun"):
            results = (msgspec.structs.replace(result, **{part: ref}),)
            message = worker.ReportResults(worker="w", session="s", results=results)
            assert refused(parser, keys.worker_key("c", "done"), message).status == "bad_blob"


@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({"token": "guess"}, "bad_token"),
        ({"token": "operate"}, "bad_token"),
        ({"protocol": codec.WIRE_VERSION + 1}, "wrong_protocol"),
        ({"worker": "a/b"}, "bad_name"),
        ({"worker": ""}, "bad_name"),
        ({"slots": 0}, "bad_message"),
        ({"fingerprint": fingerprint(packages={"numpy": "1" * 70_000})}, "bad_message"),
        ({"undescribed": ("toy/line",) * 10_001}, "bad_message"),
        ({"environments": (describe(),) * 10_001}, "bad_message"),
        ({"undescribed": ("../\x1b[2J",)}, "bad_message"),
        ({"installation": "x" * 1000}, "bad_message"),
        ({"failed_environments": {"../\x1b[2J": "x"}}, "bad_message"),
        ({"failed_environments": {f"my/e{n}": "" for n in range(10_001)}}, "bad_message"),
        ({"failed_environments": {f"my/e{n}": "x" * 2000 for n in range(33)}}, "bad_message"),
    ],
)
def test_wrong_registration_is_refused(parser: RequestParser, changes: dict[str, Any], status: str) -> None:
    values: dict[str, Any] = {"worker": "w", "token": "join", "protocol": codec.WIRE_VERSION, "slots": 1}
    values |= {"tiers": (), "environments": (), "fingerprint": fingerprint()}
    key = keys.worker_key("c", "register")
    made = event(parser, key, worker.Register(**values))
    assert len(made.session) >= 16
    assert made.size > 0
    assert refused(parser, key, worker.Register(**{**values, **changes})).status == status


@given(wait=st.floats(allow_nan=False, allow_infinity=False), cursor=st.integers(-(2**63), 2**63 - 1))
def test_waits_and_cursors_become_numbers_that_can_be_worked_with(
    tmp_path_factory: pytest.TempPathFactory, wait: float, cursor: int
) -> None:
    parser = make_parser(tmp_path_factory.getbasetemp())
    message = gateway.ResultsRequest(run="r", token="capable", submit_index=0, cursor=cursor, wait_s=wait)
    made = event(parser, keys.gateway_key("c", "r", "results"), message)
    assert 0 <= made.message.wait_s <= 60
    assert 0 <= made.message.cursor < 2**31


@pytest.mark.parametrize("index", [-1, 2**31, 2**63 - 1])
def test_submit_index_that_cannot_be_is_unknown(parser: RequestParser, index: int) -> None:
    message = gateway.ResultsRequest(run="r", token="capable", submit_index=index, cursor=0, wait_s=0)
    assert refused(parser, keys.gateway_key("c", "r", "results"), message).status == "unknown_submit"


@pytest.mark.parametrize(
    "key",
    [
        "evopolicy/v1/other/ops/status",
        "evopolicy/v1/c/else/status",
        keys.worker_key("c", "done"),
        keys.gateway_key("c", "r", "state"),
        keys.gateway_key("c", "*", "submit"),
        keys.gateway_key("c", "**", ""),
        "",
    ],
)
def test_message_on_a_wrong_key_is_refused(parser: RequestParser, key: str) -> None:
    with pytest.raises((RefusedError, ProtocolError)):
        parser.parse(key, codec.encode(submit()), CAPABILITIES.get)


@given(payload=st.binary(max_size=200), room=st.sampled_from(["work/lease", "gw/r/submit", "ops/any"]))
def test_any_bytes_are_refused_without_a_stumble(
    tmp_path_factory: pytest.TempPathFactory, payload: bytes, room: str
) -> None:
    parser = make_parser(tmp_path_factory.getbasetemp())
    with pytest.raises((RefusedError, ProtocolError)):
        parser.parse(f"evopolicy/v1/c/{room}", payload, CAPABILITIES.get)


def test_only_what_makes_something_new_asks_for_change(parser: RequestParser) -> None:
    assert parser.asks_for_change(SUBMIT, codec.encode(submit()))
    assert parser.asks_for_change(OPS, codec.encode(create()))
    assert parser.asks_for_change(OPS, codec.encode(evaluate()))
    assert not parser.asks_for_change(OPS, codec.encode(StatusRequest(token="")))
    assert not parser.asks_for_change(SUBMIT, b"junk")
    assert not parser.asks_for_change(keys.worker_key("c", "done"), codec.encode(report_results()))


MINIGRID = "gymnasium/MiniGrid-DoorKey-16x16-v0"


def test_episodes_are_cut_where_the_published_software_cuts_them_if_asked(parser: RequestParser) -> None:
    assert event(parser, OPS, create(env=MINIGRID, step_limit="published")).row.max_steps == 1000
    assert event(parser, OPS, create(env=MINIGRID, step_limit="natural")).row.max_steps == 0
    assert event(parser, OPS, create(env="gym/acrobot", step_limit="published")).row.max_steps == 0
    assert event(parser, OPS, evaluate(env=MINIGRID, step_limit="published")).row.max_steps == 1000
    assert event(parser, OPS, evaluate(env=MINIGRID)).row.max_steps == 0


def published_tree(root: Path, n_train: int) -> Path:
    """Case files as the published software has them."""
    folder = root / "toy" / "line"
    folder.mkdir(parents=True)
    numbers = iter(range(10**6))
    for split, n in (("train", n_train), ("valid", 64), ("heldout", 256)):
        cases = [{"seed": next(numbers)} for _ in range(n)]
        document = {"env": "toy/line", "split": split, "cases": cases}
        (folder / f"{split}.json").write_text(json.dumps(document))
    return root


def test_profile_published_plays_published_files_or_not_at_all(tmp_path: Path) -> None:
    def at(data: Path | None) -> RequestParser:
        return make_parser(tmp_path, data=data)

    published = {**PUBLISHED, "profile": "published", "n_validation": 16, "n_heldout": 32}
    whole = at(published_tree(tmp_path / "whole", 1024))
    made = event(whole, OPS, create(**published))
    assert (len(made.row.train), len(made.row.validation), len(made.row.heldout)) == (1024, 16, 32)
    assert not made.row.cases_secret
    assert "start it with --data" in refused(at(None), OPS, create(**published)).message
    short = at(published_tree(tmp_path / "short", 64))
    assert "1,024 cases each" in refused(short, OPS, create(**published)).message
    for name, value in (("observations", "arrays"), ("finish", "early"), ("simulation", "allowed")):
        assert f"{name} {value} (not" in refused(whole, OPS, create(**(published | {name: value}))).message
    data = published | {"profile": "published-data"}
    assert "n_validation 16 (not 64), n_heldout 32 (not 256)" in refused(whole, OPS, create(**data)).message
    made = event(whole, OPS, create(**(data | {"n_validation": 64, "n_heldout": 256})))
    assert (len(made.row.validation), len(made.row.heldout)) == (64, 256)


def finished_pair(
    parser: RequestParser, blobs: BlobStore, **settings: Any
) -> tuple[RunRow, operator.RunFinished]:
    """A run with one ok submit, whose policy is stored."""
    blobs.put(b"policy")
    row = event(parser, OPS, create(n_validation=2, n_heldout=3, **settings)).row
    submit = finished().submits[0]
    submits = (
        msgspec.structs.replace(submit, bundle=blob(b"policy").digest),
        msgspec.structs.replace(submit, submit_index=1, status="import_error"),
    )
    return row, finished(run=row.run, submits=submits)


def test_a_rescore_takes_all_but_its_cases_from_the_run(
    tmp_path: Path, blobs: BlobStore, parser: RequestParser
) -> None:
    ref, store = blob(b"policy"), Store(tmp_path / "db")
    row, result = finished_pair(parser, blobs)
    store.write([row, result])
    wanted = operator.FurtherCasesRequest(token="operate", run=row.run, name="more", n=4)
    found = parser.runs.further_cases(wanted)
    seeds = {case.seed for case in (*row.train, *row.validation, *row.heldout, *found.cases)}
    assert len(seeds) == 64 + 2 + 3 + 4
    assert parser.runs.further_cases(wanted) == found
    other = msgspec.structs.replace(wanted, name="others")
    assert parser.runs.further_cases(other).cases != found.cases
    store.write([JournalRow(seq=0, head="", entry=b"", reveals=found.epoch)])
    with pytest.raises(RefusedError, match=f"epoch new --state {tmp_path}`"):
        parser.runs.further_cases(wanted)

    message = rescore(row, found.cases, 1, 3)
    made = parser.runs.rescore(message, row, result)
    assert (made.bundle, made.split) == (ref.digest, "heldout")
    assert (made.secret, made.record) == (row.secret, "actions")
    assert made.cases == (found.cases[1], found.cases[3])
    assert made.case_ids == (4, 6)  # after the held-out ids 0 to 2
    assert made.related == (*row.validation, *row.heldout)
    assert made.as_in.modulo == len(result.submits[0].env_instances)

    def refused_for(**changes: Any) -> str:
        with pytest.raises((RefusedError, ConfigError)) as caught:
            parser.runs.rescore(msgspec.structs.replace(message, **changes), row, result)
        return str(caught.value)

    assert "not disjoint" in refused_for(cases=(*found.cases[:3], row.train[5]))
    assert "not disjoint" in refused_for(cases=(*found.cases[:3], found.cases[0]))
    assert "positions" in refused_for(indexes=(4,))
    assert "positions" in refused_for(indexes=())
    assert "no ok submit 1" in refused_for(submit_index=1)
    assert "no ok submit 9" in refused_for(submit_index=9)


@pytest.mark.parametrize("wrong", ["ab", "bb", "a-", "--"])
def test_a_rescore_of_a_world_keeps_the_runs_key(blobs: BlobStore, parser: RequestParser, wrong: str) -> None:
    """A letter stands for a case with that key, `-` for one without."""
    row, result = finished_pair(parser, blobs, env="gym/acrobot@w1")

    def cases(letters: str, first_seed: int) -> tuple[Case, ...]:
        given = [None if letter == "-" else {worlds.OPTION: letter * 32} for letter in letters]
        return tuple(Case(seed=first_seed + n, options=each) for n, each in enumerate(given))

    row = msgspec.structs.replace(row, train=cases("aa", 0), validation=(), heldout=())
    message = rescore(row, cases("aa", 7), 0, 1)
    parser.runs.rescore(message, row, result)
    with pytest.raises(ConfigError, match=f"another world than run {row.run}"):
        parser.runs.rescore(msgspec.structs.replace(message, cases=cases(wrong, 7)), row, result)


def test_a_rescore_by_policies_of_whole_submits_plays_all_cases_at_once(
    blobs: BlobStore, parser: RequestParser
) -> None:
    row, result = finished_pair(parser, blobs, policy_scope="submit")
    cases = tuple(Case(seed=seed) for seed in range(3))
    message = rescore(row, cases, 0, 1)
    with pytest.raises(RefusedError, match="all cases are played at once"):
        parser.runs.rescore(message, row, result)
    parser.runs.rescore(msgspec.structs.replace(message, indexes=(0, 1, 2)), row, result)


def test_every_kind_of_request_has_one_row() -> None:
    unions = (worker.WorkerRequest, gateway.GatewayRequest, operator.OperatorRequest)
    assert REQUESTS.keys() == {kind for union in unions for kind in get_args(union)}


def test_a_lost_run_is_opened_again_as_the_same_run(tmp_path: Path) -> None:
    def opened(state: Path, message: operator.CreateRun) -> Any:
        state.mkdir(exist_ok=True)
        return event(make_parser(state), OPS, message).row

    state, restored, other = (tmp_path / name for name in ("state", "restored", "other"))
    row = opened(state, create())
    shutil.copytree(state, restored)
    asked = msgspec.structs.replace(create(), run=row.run)
    assert opened(restored, asked) == row
    assert opened(state, msgspec.structs.replace(create(), key="k2")).run != row.run
    stranger = opened(other, create())
    theirs = {stranger.run, stranger.capability, stranger.salt, stranger.secret}
    assert theirs.isdisjoint({row.run, row.capability, row.salt, row.secret})
    assert refused(make_parser(other), OPS, asked).status == "unknown_run"


def test_the_wait_of_every_long_poll_is_bounded() -> None:
    """Attack: a wait without end, in a kind of request whose row does not say that it waits."""
    assert {kind for kind, row in REQUESTS.items() if row.waits} == {
        kind for kind in REQUESTS if "wait_s" in kind.__struct_fields__
    }
