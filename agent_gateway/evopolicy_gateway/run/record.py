"""Writes the files of a finished run.

These are `checkpoints/`, `replays/`, `logs/env.log`, the selected policy in `workspace/system/`, and `run.json` last.
They hold hidden scores, so `write` is called only when the agent and all its children are gone.

The run's result is fixed by then. A file that a bug keeps from being written is left out, with a note; the
result stays. A full disk, a lost connection, or a folder of another user ends `write`; `--resume` then writes
all files without the agent.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import traceback
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import msgspec

from evopolicy_common.errors import ConfigError, EvopolicyError, RefusedError, StorageError, TransportError
from evopolicy_common.messages import gateway
from evopolicy_common.messages.operator import RunFinished, SubmitResult
from evopolicy_common.processes.preflight import foreseen
from evopolicy_common.processes.scratch import remove_tree
from evopolicy_common.records import account, model_record
from evopolicy_common.records import run_record as schema
from evopolicy_common.records.account import Claims
from evopolicy_common.records.blobs import BlobStore, digest_of, write_atomically
from evopolicy_common.records.code_metrics import CodeMetrics
from evopolicy_common.records.open_run import Rejected, SubmitRequested
from evopolicy_common.records.policies import bundles, checkpoints
from evopolicy_common.records.policies.bundles import Bundle
from evopolicy_common.records.policies.checkpoints import CheckpointMeta
from evopolicy_common.records.run_record import Replay, RunRecord, encode_run_record, sha256_text
from evopolicy_common.records.secrets import without_keys
from evopolicy_common.records.summary import utc_text
from evopolicy_gateway.harnesses.coding_agents import session
from evopolicy_gateway.relay import limits as model_limits
from evopolicy_gateway.run.operations import Operations
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.times import Times
from evopolicy_gateway.run_folder.journal import Journal
from evopolicy_gateway.run_folder.layout import RunFolder, Staged, saved, submit_id
from evopolicy_gateway.submits.feedback import count_transitions

_RESUMABLE = (OSError, StorageError, TransportError, ConfigError)
"""Errors with a remedy, after which `--resume` writes everything."""


@contextlib.contextmanager
def _optional(part: str, log: Path, note: Callable[[str], None]) -> Iterator[None]:
    """Notes that the part of the run's directory is left out when a bug ends the `with`."""
    try:
        yield
    except _RESUMABLE:
        raise
    except Exception as error:
        note(f"{part} is left out: {why_failed(error, log)}")


def why_failed(error: Exception, log: Path) -> str:
    """Why a run or a part of it failed, in one line; writes a bug's traceback to the run's log."""
    why = foreseen(error)
    if why is None:
        why = f"{type(error).__name__}: {error}; the traceback is in {log}"
        with contextlib.suppress(OSError):
            log.parent.mkdir(parents=True, exist_ok=True)
            with log.open("a", errors="backslashreplace") as file:
                traceback.print_exception(error, file=file)
    return why


INTERRUPTED = "interrupted by you (Ctrl-C or SIGTERM)"
"""The error of a run that its command gave up for that reason."""
CANCELLED = (
    "cancelled by the operator, or because other runs waited for its agent"
    " (the coordinator's log: run_cancelled)"
)


async def write(
    folder: RunFolder,
    plan: Plan,
    finished: RunFinished,
    operations: Operations,
    times: Times,
    note: Callable[[str], None],
    error: str | None = None,
) -> RunRecord:
    """Writes all files and removes the gateway's folder. Raises StorageError when the disk refuses.

    `note` receives each omitted part. `error`: why this command gave the run up, unless the operator cancelled it.
    """
    left_out: list[str] = []
    optional = partial(_optional, log=folder.harness_log, note=left_out.append)
    selected: Bundle | None = None
    code: dict[int, CodeMetrics | None] = {}
    folder.checkpoints.mkdir(exist_ok=True)
    rejected: list[schema.RejectedSubmit] = []
    kept: dict[int, str | None] = {}
    with optional("the gateway's journal"):
        rejected, kept = await asyncio.to_thread(_from_journal, folder)
    for submit in finished.submits:
        code[submit.submit_index] = None
        name = submit_id(submit.submit_index, finished.budget)
        with optional(f"checkpoint {name}"):
            digest = submit.bundle or kept.get(submit.submit_index)
            bundle = await asyncio.to_thread(_own_bundle, folder, digest)
            if bundle is None and submit.bundle is not None:
                bundle = bundles.load(await operations.download(submit.bundle), submit.bundle)
            if submit.submit_index == finished.best_submit_index:
                selected = bundle
            metrics = None
            with optional(f"metrics.json of {name}"):
                metrics = await asyncio.to_thread(checkpoints.measured, bundle)
            made = (_meta(submit), bundle, metrics)
            await asyncio.to_thread(checkpoints.write, folder.checkpoints / name, *made)
            code[submit.submit_index] = metrics
    if selected is not None:
        with optional("the selected policy in workspace/system"):
            files = checkpoints.without_metadata(selected.files)
            await asyncio.to_thread(_put_in_place, folder.system, files)
    gave_up, why = False, finished.error
    if finished.status == "cancelled":
        gave_up, why = error not in (None, INTERRUPTED), error or finished.error or CANCELLED
    replays: tuple[Replay, ...] = ()
    with optional("the recordings of held-out episodes"):
        replays = await fetch_replays(folder.root, finished, operations)

    def finish() -> RunRecord:
        staged = saved(folder.staged, Staged) if folder.staged.exists() else None
        if staged is not None:
            # The agent's log exists even when the agent printed nothing.
            folder.agent_log.touch()
        with optional("logs/env.log"):
            write_atomically(folder.env_log, _env_log(finished))
        transitions: dict[str, int] | None = None
        # At the level `scores` the feedback has no rows to count.
        if plan.settings.feedback != "scores":
            with optional("the number of steps"):
                transitions = count_transitions(folder.feedback)
        facts = finished.agent
        with optional("the agent's use of its model"):
            facts = _complete(folder, plan, facts)
        told = msgspec.structs.replace(
            claims(plan, facts, staged, times),
            error=why,
            gave_up=gave_up,
            code=code,
            transitions=transitions,
            rejected_submits=tuple(rejected),
            artifacts=folder.artifacts(),
            replays=replays,
        )
        done = account.run_record(finished, told)
        write_atomically(folder.run_json, encode_run_record(done))
        # A later command removes the rest.
        with contextlib.suppress(OSError):
            remove_tree(folder.state)
        return done

    done = await asyncio.to_thread(finish)
    for text in left_out:
        note(text)
    return done


def claims(plan: Plan, facts: dict[str, object], staged: Staged | None, times: Times) -> Claims:
    """This side's facts about a run before its end; pure. `facts`: about the agent. `staged` None: no workspace."""
    return Claims(
        agent=_agent(plan, facts, times),
        jail=plan.jail.recorded,
        agents_md_hash="" if staged is None else sha256_text(staged.agents_md_hash),
        rules_hash="" if staged is None else sha256_text(staged.rules_hash),
        initial_policy_hash=None if staged is None else sha256_text(staged.initial_policy_hash),
        harness=f"evopolicy {version('evopolicy')}",
        agent_s=max(0.0, times.open_s - times.in_flight_s),
        feedback_s=times.feedback_s,
        held_s=times.held_s,
        permit_s=times.permit_s,
    )


def told_at_close(folder: RunFolder, plan: Plan, facts: dict[str, object], times: Times) -> dict[str, Any]:
    """The `Told` of `run.json`, as it is published: the coordinator commits to it when the run ends."""
    staged = saved(folder.staged, Staged) if folder.staged.exists() else None
    known = claims(plan, _complete(folder, plan, facts), staged, times)
    settings = {
        name: each for name, each in known.agent.settings.items() if name in schema.PUBLISHED_SETTINGS
    }
    told = msgspec.convert(known, account.Told, from_attributes=True)
    agent = msgspec.structs.replace(known.agent, settings=settings)
    return cast(dict[str, Any], msgspec.to_builtins(msgspec.structs.replace(told, agent=agent)))


def _complete(folder: RunFolder, plan: Plan, facts: dict[str, Any]) -> dict[str, Any]:
    """Facts about the agent, with those of its settings, its session's file and the relay's ledger."""
    try:
        harness = plan.harness()
    except EvopolicyError:  # its file or its key has gone meanwhile
        return facts
    state = session.load(folder.session)
    known = harness.known_facts()
    known["cli_version"] = state.cli_version
    known |= {name: value for name, value in facts.items() if value is not None}
    known |= {name: max(getattr(state, name), int(facts.get(name, 0))) for name in ("turns", "retries")}
    known["settings"] = {**harness.known_facts().get("settings", {}), **facts.get("settings", {})}
    if (terms := harness.model) is None:
        if state.used:  # a remote agent's own count, by model
            known["model_string"] = max(state.used, key=lambda model: state.used[model].total)
            known |= {"tokens": state.usage.recorded(None), "model_use": schema.ModelUse(metering="agent")}
        return known
    limits = msgspec.convert(terms.limits, schema.ModelLimits, from_attributes=True)
    own = facts.get("tokens") or (state.usage.recorded(terms.prices) if state.usage.total else None)
    if not folder.model_requests.exists():
        return known | {"tokens": own, "model_use": schema.ModelUse(metering="agent", limits=limits)}
    used = model_limits.read_ledger(folder.model_requests, terms.model)
    answered = used.requests - used.failed
    known["model_string"] = known.get("model_string") or max(
        used.models, key=used.models.__getitem__, default=None
    )
    known["tokens"] = used.recorded(terms.prices)
    known["model_use"] = schema.ModelUse(
        metering="relay",
        limits=limits,
        requests=used.requests,
        requests_failed=used.failed,
        requests_estimated=used.estimated,
        models=used.models,
        other_models=used.other_models,
        hosted_tools=used.hosted_tools,
        first_token_s=round(used.first_s / answered, 4) if answered else None,
        rate_limit_s=round(used.wait_s, 3),
        record=plan.record_model,
        record_stopped=model_record.stopped(folder.root),
        reported=None if own is None else msgspec.convert(own, schema.Tokens),
    )
    return known


def _agent(plan: Plan, facts: dict[str, Any], times: Times) -> schema.Agent:
    tokens = facts.get("tokens")
    own: dict[str, Any] = {"agent": plan.agent}
    own |= {"wall_limit_s": plan.wall_limit_s, "silence_limit_s": plan.silence_s}
    if jail := plan.jail.chosen():
        own["jail"] = jail
    return schema.Agent(
        entry=plan.settings.entry,
        inputs=plan.texts.inputs,
        harness=facts.get("harness") or plan.agent.partition(":")[0],
        settings=without_keys(own | facts.get("settings", {})),
        tokens=None if tokens is None else msgspec.convert(tokens, schema.Tokens),
        resources=times.resources,
        retries=int(facts.get("retries", 0)),
        turns=int(facts.get("turns", 0)),
        cli_version=facts.get("cli_version"),
        model_string=facts.get("model_string"),
        model_use=facts.get("model_use"),
    )


def _own_bundle(folder: RunFolder, digest: str | None) -> Bundle | None:
    """Reads the bundle from the gateway's store; None when it is missing there."""
    if digest is not None and folder.blobs.is_dir():
        with contextlib.suppress(StorageError):
            return bundles.load(BlobStore(folder.blobs).read_blob(digest), digest)
    return None


def _from_journal(folder: RunFolder) -> tuple[list[schema.RejectedSubmit], dict[int, str | None]]:
    """The refused requests, and by submit the digest of a `system/` without a policy, which only the gateway has."""
    if not folder.journal.exists():
        return [], {}
    with contextlib.closing(Journal(folder.journal)) as journal:
        entries = journal.entries.values()
    rejected: list[schema.RejectedSubmit] = []
    kept: dict[int, str | None] = {}
    for entry in entries:
        if isinstance(entry, SubmitRequested):
            requested = entry
        elif isinstance(entry, gateway.SubmitAccepted):
            kept[entry.submit_index] = requested.kept
        elif isinstance(entry, Rejected):
            rejected.append(entry.submit)
    return rejected, kept


def _meta(submit: SubmitResult) -> CheckpointMeta:
    requested = len(submit.env_instances)
    charged = 0 if submit.status == gateway.CANCELLED else requested
    return CheckpointMeta(
        submit_index=submit.submit_index,
        submit_time=utc_text(submit.started_at),
        n_episodes_requested=requested,
        remaining_budget_before=submit.remaining_budget + charged,
        remaining_budget_after=submit.remaining_budget,
        validation_status=submit.status,
        mean_return=submit.mean_return,
        val_mean=submit.val_mean,
    )


def _env_log(finished: RunFinished) -> bytes:
    """JSON lines: the environment's version, the played episodes and their results."""
    settings, best = finished.settings, finished.best_submit_index
    events: list[tuple[str, dict[str, object]]] = [
        ("environment", {"env": settings.env, "version": finished.env_version})
    ]
    for one in finished.submits:
        times = {"started_at": utc_text(one.started_at), "completed_at": utc_text(one.completed_at)}
        played = {"env_instances": one.env_instances, "status": one.status, "mean_return": one.mean_return}
        events.append(("train", {"submit_index": one.submit_index, **times, **played}))
    for index, score in finished.val_scores.items():
        events.append(("validation", {"submit_index": index, "mean_return": score}))
    events += [("not_eligible", {"submit_index": index}) for index in finished.validation_ineligible]
    if finished.heldout_returns:
        events.append(("heldout", {"submit_index": best, "returns": finished.heldout_returns}))
    if finished.random_heldout_returns:
        events.append(("random_reference", {"returns": finished.random_heldout_returns}))
    events.append(("finished", {"at": utc_text(finished.finished_at), "status": finished.status}))
    return b"".join(msgspec.json.encode({"event": kind, **about}) + b"\n" for kind, about in events)


def _put_in_place(system: Path, bundle: Bundle) -> None:
    """Replaces `system/` by the bundle, whatever it contains. Raises ConfigError when it cannot be removed."""
    # Only a real folder is removed recursively; opening a pipe would block until its other end opens.
    if system.is_dir() and not system.is_symlink():
        remove_tree(system)
        if system.exists():
            raise ConfigError(
                f"{system} cannot be removed: another user owns folders in it, such as the root of the agent's"
                f" container; make them yours (chown -R {os.getuid()} {system.parent}), then continue with --resume"
            )
    else:
        system.unlink(missing_ok=True)
    bundles.unpack(bundle, system)


async def fetch_replays(root: Path, finished: RunFinished, operations: Operations) -> tuple[Replay, ...]:
    """Writes `replays/heldout_NNN/video.mp4` below the run directory `root`; returns one `Replay` each in the split's
    order. NNN is the position in the split: the case's seed appears nowhere. A recording that a worker could not make,
    or that the cluster no longer has, is left out; one that is in place is not fetched again."""
    index = finished.best_submit_index
    if finished.settings.recorded_heldout == "off" or index is None:
        return ()
    recordings: list[Replay] = []
    async for outcome in operations.recorded(finished.run, "heldout", index):
        if outcome.video is None:
            continue
        path = f"replays/heldout_{outcome.index:03d}/video.mp4"
        target = root / path
        data = await asyncio.to_thread(target.read_bytes) if target.is_file() else b""
        if digest_of(data) != outcome.video.digest:
            try:
                data = await operations.fetch(outcome.video)
            except RefusedError:
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            await asyncio.to_thread(write_atomically, target, data)
        replay = Replay(path=path, split="heldout", episode=outcome.index, submit_index=index)
        played = msgspec.structs.replace(replay, episode_return=outcome.episode_return, length=outcome.length)
        recordings.append(played)
    return tuple(sorted(recordings, key=lambda replay: replay.episode))
