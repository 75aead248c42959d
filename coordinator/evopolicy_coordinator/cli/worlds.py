"""`evopolicy-coordinator accept-worlds`: tries candidates of worlds, in their order, and writes the journal
of them.

It plays on a cluster of its own, whose cases come from a temporary folder: `ENV@w1` has the rules of the
candidate that is tried. A repeated command continues with the first candidate that the journal does not
have.
"""

from __future__ import annotations

import asyncio
import math
import time
import uuid
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from evopolicy_common import catalogue
from evopolicy_common.catalogue.worlds import CANDIDATES, N_WORLDS, ids, unchanged
from evopolicy_common.cli.conventions import State, end_on_sigterm, run_to_end
from evopolicy_common.errors import ConfigError
from evopolicy_common.local.cluster import local_cluster, unless_failed
from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.operator import DescribeEnvironment, Evaluate
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_common.records import splits as split_files
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.journal import epoch_of
from evopolicy_common.records.policies.bundles import Bundle, snapshot
from evopolicy_common.terminal import counted, number, say
from evopolicy_common.wire import credentials, transport
from evopolicy_common.worlds.rules import PARAMETERS, Rules
from evopolicy_common.worlds.transformed import transformed, varied
from evopolicy_coordinator import splits, worlds
from evopolicy_coordinator.storage.state_folder import held_folder
from evopolicy_results.evaluations import Evaluations

_COUNTS: dict[Split, int] = {"train": worlds.CASES, "validation": 1, "heldout": 1}


def accept_worlds(
    env: Annotated[
        list[str] | None,
        typer.Argument(metavar="[ENV]...", help="Environments of Core16, or globs. Default: all of them."),
    ] = None,
    policies: Annotated[
        Path,
        typer.Option(
            exists=True,
            file_okay=False,
            help="Folder with a folder of canonical policies for each environment.",
        ),
    ] = Path("examples/policies"),
    state: State = None,
) -> None:
    """Choose the rules of an epoch's worlds: play candidates in a fixed order, and accept by a fixed rule.

    Writes STATE/worlds.jsonl, which the coordinator of this state folder reads. Run it before the epoch's
    first run; repeat an interrupted command to continue it.
    """
    root = state or credentials.default_state_dir()
    core16 = catalogue.suites()["core16"].environments
    env_ids = catalogue.resolve(env or ["core16"])
    if others := [each for each in env_ids if each not in core16]:
        raise ConfigError(f"{others[0]} has no worlds; those of Core16 have some: {', '.join(core16)}")
    with held_folder(root):
        secret = splits.load_or_create_secret(root / splits.SECRET)
        run_to_end(_accept(env_ids, policies, root / worlds.JOURNAL, secret))
    say(f"next: evopolicy-coordinator --state {root}")


async def _accept(env_ids: list[str], policies: Path, journal: Path, secret: bytes) -> None:
    end_on_sigterm()
    began = time.monotonic()
    with scratch_folder("worlds") as data:
        async with local_cluster("accept-worlds", data=data) as cluster:
            offered = [each for env in env_ids for each in (env, ids(env)[0])]
            await cluster.start_workers(offered, tiers={"bwrap"})
            operator = credentials.find("operator", (), cluster.operator_file)
            async with transport.connect(operator) as link:
                trials = _Trials(journal, secret, data, Evaluations(link, lambda _, __: None, own=True))

                async def work() -> None:
                    for env in env_ids:
                        await trials.environment(env, catalogue.policy_folder(policies, env))

                await unless_failed(asyncio.create_task(work()), cluster.failed)
    say(f"{counted(len(env_ids), 'environment')} in {time.monotonic() - began:.0f} s")


class _Trials:
    """The trials of one epoch's candidates: their journal, and evaluations on the command's own cluster. All
    evaluations of an environment play the same cases."""

    def __init__(self, journal: Path, secret: bytes, data: Path, evaluations: Evaluations) -> None:
        self._journal, self._secret, self._epoch = journal, secret, epoch_of(secret)
        self._data, self._evaluations = data, evaluations

    async def environment(self, env: str, folder: Path) -> None:
        """Tries candidates of an environment until enough are accepted."""
        policy = snapshot(folder) if (folder / "policy.py").is_file() else None
        digest = policy.digest if policy else ""
        entries = worlds.of_environment(worlds.read_journal(self._journal), self._epoch, env)
        if not entries:
            new = worlds.Base(epoch=self._epoch, env=env, policy=digest)
            if policy is not None:
                scores = [await self._mean(env, each, "") for each in (None, policy)]
                new = msgspec.structs.replace(new, random=scores[0], canonical=scores[1])
            worlds.append(self._journal, new)
            scores_text = f"random {number(new.random)}, policy {number(new.canonical)}"
            say(f"{env}: {scores_text if policy else 'no policy is known, so no world is accepted'}")
            entries = [new]
        base, tried = entries[0], [each for each in entries if isinstance(each, worlds.Candidate)]
        assert isinstance(base, worlds.Base)
        if base.policy != digest:
            raise ConfigError(
                f"{folder} is not the policy with which this epoch's candidates of {env} are tried"
                f" ({base.policy[:16] or 'none'}): restore it"
            )
        while policy and len(tried) < CANDIDATES and sum(each.accepted for each in tried) < N_WORLDS:
            one = await self._candidate(base, policy, len(tried))
            worlds.append(self._journal, one)
            verdict = "accepted" if one.accepted else "rejected"
            scores_text = f"policy {number(one.canonical)}, ceiling {number(one.ceiling)}"
            say(f"{env}, candidate {one.number}: {verdict} ({scores_text})")
            tried.append(one)

    async def _candidate(self, base: worlds.Base, policy: Bundle, n: int) -> worlds.Candidate:
        world, key = ids(base.env)[0], worlds.key_of(self._secret, base.env, n)
        canonical = await self._mean(world, policy, key)
        ceiling, variants = None, 0
        if worlds.loses(base, canonical):
            await self._evaluations.versions(DescribeEnvironment(env=world))
            offered, *_ = await self._evaluations.ask.environments()
            described = next(each.description for each in offered if each.description.env == world)
            names = tuple(described.definition.get("parameters", ()))
            rules = Rules(key, described.obs_space, described.action_space, names)
            for variants in range(1, 2 + (worlds.VARIANTS if PARAMETERS in rules.kinds else 0)):
                variant = transformed(varied(policy, variants - 1), rules)
                mean = await self._mean(world, variant, key)
                ceiling = mean if ceiling is None else max(mean, ceiling)
                if worlds.reaches(base, ceiling):
                    break
        return worlds.Candidate(
            epoch=base.epoch,
            env=base.env,
            number=n,
            canonical=canonical,
            ceiling=ceiling,
            variants=variants,
            accepted=ceiling is not None and worlds.reaches(base, ceiling),
        )

    async def _mean(self, env: str, bundle: Bundle | None, key: str) -> float:
        """Mean return of a policy, or of random actions, in an environment or in a world with a key."""
        # The coordinator reads the files of the cases at each request.
        derived = splits.derive(self._secret, "acceptance", unchanged(env), _COUNTS)
        folder = self._data / catalogue.folder_name(env)
        folder.mkdir(exist_ok=True)
        for split, cases in splits.in_world(env, key, derived).items():
            stem = split_files.FILE_STEMS[split]
            content = split_files.SplitFile(env=env, split=stem, cases=cases, secret=True)
            write_atomically(folder / f"{stem}.json", msgspec.json.encode(content), mode=0o600)
        if bundle is not None:
            await self._evaluations.ask.upload(bundle.digest, bundle.packed)
        message = Evaluate(
            key=uuid.uuid4().hex,
            env=env,
            bundle=None if bundle is None else bundle.digest,
            split="train",
            cases=None,
            record="actions",
        )
        returns = [float(each.episode_return) async for each in self._evaluations.outcomes(message)]
        return math.fsum(returns) / len(returns)
