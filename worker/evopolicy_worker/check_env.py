"""`evopolicy-worker check-env`: plays environments in two processes and prints which interface rules they violate."""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Annotated

import msgspec
import numpy as np
import typer

from evopolicy_common import catalogue
from evopolicy_common.catalogue import Entry, installs
from evopolicy_common.cli.conventions import fail_on_our_errors
from evopolicy_common.console import table, terminal
from evopolicy_common.errors import EvopolicyError, WorkerError
from evopolicy_common.messages.environment import Case, EnvironmentDescription
from evopolicy_common.messages.episode import EpisodeSpec, Job, Tier
from evopolicy_common.processes.preflight import check_writable
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_common.regular_files import read_given
from evopolicy_common.terminal import say
from evopolicy_worker import environments
from evopolicy_worker.environments.checks.conformance import SEEDS, CheckResult
from evopolicy_worker.environments.interface.actions import compile_actions
from evopolicy_worker.slots.slot import Slot, available_tiers

HASH_SEEDS = ("0", "1")
STEPS = 600
"""Greatest number of steps of an episode."""
SLOT_STEPS = 100
"""The same in a slot."""
MOST_MEMORY_MB = 600
"""A slot whose processes need more is a fault: workers have a slot for each core."""
COLUMNS = (
    "environment", "limit", "played", "ends", "same episode", "drawn", "bytes a step", "MB", "verdict"
)  # fmt: skip
_POLICY = """
class Policy:
    def __init__(self, *spaces): pass
    def reset(self, episode_index): pass
    def act(self, obs): return ACTION

ACTION = """


class InASlot(msgspec.Struct, frozen=True, kw_only=True):
    """An episode in a worker's slot."""

    memory_mb: int = 0
    """Memory of all of the slot's processes after it, MiB; shared memory counts for each."""
    fault: str = ""
    """Why an episode could not be played."""
    notes: str = ""
    """As `EnvironmentDescription.notes`."""


class CheckedEnvironment(msgspec.Struct, frozen=True):
    """One environment, played in two processes with different hash seeds."""

    here: CheckResult
    there: CheckResult
    slot: InASlot = InASlot()

    @property
    def verdict(self) -> str:
        wrong = [self.here.verdict(self.there), self.slot.fault]
        if self.slot.memory_mb > MOST_MEMORY_MB:
            wrong.append(f"its slot needs {self.slot.memory_mb:,} MB; {MOST_MEMORY_MB} are the limit")
        return "; ".join(each for each in wrong if each not in ("", "ok")) or "ok"

    def cells(self) -> tuple[str, ...]:
        """The table row, in the order of `COLUMNS`."""
        here = self.here
        same = here.fresh and here.reused and here.digest == self.there.digest
        how = "no" if not same else "rebuilt" if here.rebuilt else "reused"
        memory = f"{self.slot.memory_mb or here.memory_mb:,}"
        played = (here.env, f"{here.limit:,}", f"{here.steps:,}", here.ended, how, here.rendered)
        return (*played, f"{here.step_bytes:,}", memory, self.verdict)


def check(
    env_ids: Sequence[str], definitions: tuple[Entry, ...], steps: int = STEPS
) -> Iterator[CheckedEnvironment]:
    """Yields each environment when both processes and a slot have played it. Raises WorkerError when one of the
    processes ends too early."""
    with contextlib.ExitStack() as stack:
        answers = [
            stack.enter_context(_conformance(env_ids, definitions, steps, hash_seed))
            for hash_seed in HASH_SEEDS
        ]
        for env_id in env_ids:
            lines = [answer.readline() for answer in answers]
            if not all(lines):
                raise WorkerError(f"the process that plays {env_id} has ended")
            here, there = (msgspec.json.decode(line, type=CheckResult) for line in lines)
            own = tuple(each for each in definitions if each.id == env_id)
            slot = InASlot() if here.faults else in_a_slot(env_id, own)
            yield CheckedEnvironment(here, there, slot)


@contextlib.contextmanager
def _conformance(
    env_ids: Sequence[str], definitions: tuple[Entry, ...], steps: int, hash_seed: str
) -> Iterator[IO[bytes]]:
    """The output of the running program `environments.checks.conformance`."""
    program = "evopolicy_worker.environments.checks.conformance"
    command = [sys.executable, "-P", "-m", program, str(steps), *env_ids]
    # In a folder that is removed even if the process is killed.
    with scratch_folder("check") as scratch:
        variables = environments.process_environment(render=True)
        variables |= {"PYTHONHASHSEED": hash_seed, "TMPDIR": str(scratch)}
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=os.environ | variables
        )
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with contextlib.suppress(BrokenPipeError), process.stdin as asked:
                asked.write(msgspec.json.encode(definitions) + b"\n")
            yield process.stdout
        finally:
            process.kill()
            process.wait()
            process.stdout.close()


def in_a_slot(env_id: str, definitions: tuple[Entry, ...]) -> InASlot:
    """Plays the begin of one train episode in a slot of its own, with the neutral action at each step."""
    return asyncio.run(_in_a_slot(env_id, available_tiers(unsandboxed=True)[0], definitions))


async def _in_a_slot(env_id: str, tier: Tier, definitions: tuple[Entry, ...]) -> InASlot:
    with scratch_folder("check") as scratch:
        slot = Slot(None, tier, scratch / "slot", definitions=definitions)
        bundle = scratch / "bundle"
        bundle.mkdir()
        try:
            await slot.start()
            (description,) = await slot.describe([env_id])
            action = literal(compile_actions(description.action_space).neutral())
            (bundle / "policy.py").write_text(_POLICY + repr(action))
            (outcome,) = await slot.play_job(_job(description, tier), bundle, lambda episodes, steps: None)
            if outcome.failure is not None:
                raise WorkerError(outcome.failure.message[:200])
            return InASlot(memory_mb=slot.memory_bytes() >> 20, notes=description.notes())
        except EvopolicyError as error:
            return InASlot(fault=f"in a slot: {error}"[:300])
        finally:
            await slot.close()


def _job(description: EnvironmentDescription, tier: Tier) -> Job:
    meta = {
        "env": description.env,
        "submit_index": 0,
        "n_episodes_this_submit": 1,
        "remaining_budget_after": 0,
        "max_episode_steps": description.max_episode_steps,
    }
    spec = EpisodeSpec(index=0, episode_index=0, case=Case(seed=SEEDS[0]), policy_seed=bytes(16))
    return Job(
        job_id="check",
        env=description.env,
        bundle="check",
        episodes=(spec,),
        env_meta=meta,
        tier=tier,
        render=True,
        max_steps=SLOT_STEPS,
    )


def literal(value: object) -> object:
    """An action as a Python literal."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, dict):
        return {key: literal(part) for key, part in value.items()}
    if isinstance(value, tuple):
        return tuple(map(literal, value))
    return value


def command(
    env: Annotated[list[str], typer.Argument(help="Ids, suites, globs, or files of environments.")],
    results: Annotated[
        Path | None,
        typer.Option(
            hidden=True, help="File for results, one line of JSON each; results in it are not measured again."
        ),
    ] = None,
) -> None:
    """Play environments and check that they follow the rules of the interface.

    Example: evopolicy-worker check-env gymnasium/CartPole-v1 my_pkg:MyEnv-v0

    The rules: observations within their spaces; invalid actions repaired; the same episode when repeated (fresh,
    reused, in another process, rendered); no seed in observations or info; the step limit; nothing pickled. The table
    also shows the memory of a worker's slot that plays the environment. Environments run with your
    rights, except in the slot. Exit code 1 if one breaks a rule.
    """
    with fail_on_our_errors():
        wanted = catalogue.resolve(env)
        if results is not None:
            check_writable(results.parent, "--results")
            results.parent.mkdir(parents=True, exist_ok=True)
        known = {} if results is None else read_checked(results)
        todo = [each for each in wanted if each not in known]
        divided = installs.divided(todo)
        here = divided.pop(sys.executable, [])
        environments.check_played(here)
        foreign = tuple(catalogue.entry(each) for each in here if not catalogue.is_shipped(each))
        for done, checked in enumerate(check(here, foreign), 1):
            known[checked.here.env] = checked
            say(f"{done} of {len(here)}: {checked.here.env}: {checked.verdict}", err=True)
            if results is not None:
                with results.open("ab") as file:
                    file.write(msgspec.json.encode(checked) + b"\n")
        for python, elsewhere in divided.items():
            with scratch_folder("check") as scratch:
                kept = results or scratch / "results.jsonl"
                program = [python, "-P", "-m", "evopolicy_worker.cli", "check-env", "--results", str(kept)]
                program += elsewhere
                status = subprocess.run(program, stdout=subprocess.DEVNULL, check=False).returncode
                known |= read_checked(kept)
            if lost := [each for each in elsewhere if each not in known]:
                raise WorkerError(f"{python} has ended with status {status} before {lost[0]}")
        shown = table(*COLUMNS)
        for each in wanted:
            shown.add_row(*known[each].cells())
        terminal().print(shown)
        for each in filter(None, (known[each].slot.notes for each in wanted)):
            say(f"note: {each}", err=True)
        raise typer.Exit(any(known[each].verdict != "ok" for each in wanted))


def read_checked(results: Path) -> dict[str, CheckedEnvironment]:
    """Results in the file, by environment id. Skips truncated lines, so that those environments are played again."""
    by_env: dict[str, CheckedEnvironment] = {}
    data = read_given(results, f"--results {results}") if results.exists() else b""
    for line in data.splitlines():
        try:
            checked = msgspec.json.decode(line, type=CheckedEnvironment)
        except msgspec.MsgspecError:
            continue
        by_env[checked.here.env] = checked
    return by_env
