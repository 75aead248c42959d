"""`evopolicy-worker check-env`: plays environments in two processes and prints which interface rules they violate."""

from __future__ import annotations

import asyncio
import contextlib
import os
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
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
from evopolicy_worker.environments.checks.costs import Stretch, literal
from evopolicy_worker.environments.interface.actions import compile_actions
from evopolicy_worker.slots.slot import Slot
from evopolicy_worker.slots.tiers import available_tiers

HASH_SEEDS = ("0", "1")
STEPS = 600
"""Greatest number of steps of an episode."""
MOST_MEMORY_MB = 600
"""A slot whose processes need more is a fault: workers have a slot for each core."""
_PLAYED = ("environment", "limit", "played", "ends", "same episode", "drawn")
COLUMNS = (*_PLAYED, "CPU µs, bare", "CPU µs, slot", "bytes a step", "MB", "verdict")
TIMES = slice(len(_PLAYED), len(_PLAYED) + 2)
"""The cells of processor time, which have a table of their own on a page: few environments are measured."""
TURNS = 3
LEAST_S = 2e-3
"""Processor time of an episode's start varies by about this."""
_POLICY = """
class Policy:
    def __init__(self, *spaces): pass
    def reset(self, episode_index): self.actions = iter(ACTIONS)
    def act(self, obs): return next(self.actions)

ACTIONS = """


class InASlot(msgspec.Struct, frozen=True, kw_only=True):
    """The cost of a worker's slot that plays the environment, with its policy, and of the bare environment beside
    it."""

    bare_us: float = 0.0
    """Processor time of a step of the library's environment, without adapter and accelerations, µs; the
    median of `TURNS`. 0: not measured, as of an episode of one step."""
    slot_us: float = 0.0
    """The same for the slot, with its policy, recording and accelerations. 0 also where all steps together
    take less than `LEAST_S`."""
    busy: bool = False
    """Whether the machine had more to do than it has cores."""
    memory_mb: int = 0
    """Memory of all of the slot's processes after it, MiB; shared memory counts for each."""
    fault: str = ""
    """Why an episode could not be played."""
    notes: str = ""
    """As `EnvironmentDescription.notes`."""

    def times(self) -> tuple[str, str]:
        """Both times as a table has them."""
        mark = "*" if self.busy else ""
        bare, slot = (f"{_digits(us)}{mark}" if us else "" for us in (self.bare_us, self.slot_us))
        return bare, slot


class Checked(msgspec.Struct, frozen=True):
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
        return (*played, *self.slot.times(), f"{here.step_bytes:,}", memory, self.verdict)


def check(env_ids: Sequence[str], definitions: tuple[Entry, ...], steps: int = STEPS) -> Iterator[Checked]:
    """Yields each environment when both processes and a slot have played it. Raises WorkerError when one of the
    processes ends too early."""
    variables = environments.process_environment(render=True)
    with contextlib.ExitStack() as stack:
        programs = [
            _program(definitions, variables | {"PYTHONHASHSEED": seed}, "conformance", str(steps), *env_ids)
            for seed in HASH_SEEDS
        ]
        processes = [stack.enter_context(program) for program in programs]
        bare = stack.enter_context(bare_loop(definitions))
        for env_id in env_ids:
            lines = [answer() for answer in processes]
            if not all(lines):
                raise WorkerError(f"the process that plays {env_id} has ended")
            here, there = (msgspec.json.decode(line, type=CheckResult) for line in lines)
            own = tuple(each for each in definitions if each.id == env_id)
            slot = InASlot() if here.faults else in_a_slot(env_id, own, bare)
            yield Checked(here, there, slot)


@contextlib.contextmanager
def _program(
    definitions: tuple[Entry, ...], variables: dict[str, str], name: str, *arguments: str
) -> Iterator[Callable[..., bytes]]:
    """A running program of `environments.checks`: sends it a line, if one is given, and returns its next
    line, which is empty once it has ended."""
    command = [sys.executable, "-P", "-m", f"evopolicy_worker.environments.checks.{name}", *arguments]
    # In a folder that is removed even if the process is killed.
    with scratch_folder("check") as scratch:
        environment = os.environ | variables | {"TMPDIR": str(scratch)}
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
        asked, answers = process.stdin, process.stdout
        assert asked is not None
        assert answers is not None

        def answer(line: bytes = b"") -> bytes:
            with contextlib.suppress(BrokenPipeError):
                asked.write(line)
                asked.flush()
            return answers.readline()

        try:
            asked.write(msgspec.json.encode(definitions) + b"\n")
            asked.flush()
            yield answer
        finally:
            process.kill()
            process.wait()
            answers.close()
            with contextlib.suppress(BrokenPipeError):  # what was not read is still held
                asked.close()


@contextlib.contextmanager
def bare_loop(definitions: tuple[Entry, ...]) -> Iterator[Callable[[str], Stretch]]:
    """A process that plays the stretch of an environment without a slot, at each call; see `costs`."""
    variables = environments.process_environment(accelerations=False)
    with _program(definitions, variables, "costs") as answer:

        def play(env_id: str) -> Stretch:
            # An environment that has ended the process costs later ones their bare times, not their checks.
            line = answer(f"{env_id}\n".encode())
            return msgspec.json.decode(line, type=Stretch) if line else Stretch(fault="its process ended")

        yield play


def in_a_slot(env_id: str, definitions: tuple[Entry, ...], bare: Callable[[str], Stretch]) -> InASlot:
    """Plays the begin of one train episode bare, and in a slot of its own once for one step and once for all its steps:
    the difference is of steps alone."""
    tier = available_tiers(unsandboxed=True)[0]
    return asyncio.run(_in_a_slot(env_id, tier, definitions, bare))


async def _in_a_slot(
    env_id: str, tier: Tier, definitions: tuple[Entry, ...], bare: Callable[[str], Stretch]
) -> InASlot:
    with scratch_folder("check") as scratch:
        slot = Slot(None, tier, scratch / "slot", definitions=definitions)
        bundle = scratch / "bundle"
        bundle.mkdir()
        try:
            await slot.start()
            (description,) = await slot.describe([env_id])
            first = bare(env_id)
            neutral = literal(compile_actions(description.action_space).neutral())
            (bundle / "policy.py").write_text(_POLICY + repr(first.actions or [neutral]))
            n = len(first.actions)
            bare_s, slot_s = [first.cpu_s], []
            for turn in range(TURNS if n > 1 else 1):
                if turn:
                    bare_s.append(bare(env_id).cpu_s)
                short, whole = [await _played(slot, description, tier, k, bundle) for k in (1, max(n, 1))]
                slot_s.append(whole - short)
            slot_each = statistics.median(slot_s)
            return InASlot(
                bare_us=round(1e6 * statistics.median(bare_s) / n, 2) if n else 0.0,
                slot_us=round(1e6 * slot_each / (n - 1), 2) if slot_each > LEAST_S else 0.0,
                busy=os.getloadavg()[0] > len(os.sched_getaffinity(0)),
                memory_mb=slot.memory_bytes() >> 20,
                notes=description.notes(),
            )
        except EvopolicyError as error:
            return InASlot(fault=f"in a slot: {error}"[:300])
        finally:
            await slot.close()


async def _played(
    slot: Slot, description: EnvironmentDescription, tier: Tier, steps: int, bundle: Path
) -> float:
    """Processor time of all of the slot's processes for an episode of at most so many steps, seconds."""
    meta = {
        "env": description.env,
        "submit_index": 0,
        "n_episodes_this_submit": 1,
        "remaining_budget_after": 0,
        "max_episode_steps": description.max_episode_steps,
    }
    spec = EpisodeSpec(index=0, episode_index=0, case=Case(seed=SEEDS[0]), policy_seed=bytes(16))
    job = Job(
        job_id="check",
        env=description.env,
        bundle="check",
        episodes=(spec,),
        env_meta=meta,
        tier=tier,
        render=True,
        max_steps=steps,
    )
    before = slot.cpu_s()
    (outcome,) = await slot.play(job, bundle, lambda episodes, steps: None)
    if outcome.failure is not None:
        raise WorkerError(outcome.failure.message[:200])
    return slot.cpu_s() - before + outcome.policy_cpu_s


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
    reused, in another process, rendered); no seed in observations or info; the step limit; nothing pickled. Also
    measures the time of a step, and the slot's memory. Environments run with your rights, except in the slot. Exit
    code 1 if one breaks a rule.
    """
    with fail_on_our_errors():
        wanted = catalogue.resolve(env)
        if results is not None:
            check_writable(results.parent, "--results")
            results.parent.mkdir(parents=True, exist_ok=True)
        known = {} if results is None else read(results)
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
                known |= read(kept)
            if lost := [each for each in elsewhere if each not in known]:
                raise WorkerError(f"{python} has ended with status {status} before {lost[0]}")
        shown = table(*COLUMNS)
        for each in wanted:
            shown.add_row(*known[each].cells())
        terminal().print(shown)
        for each in filter(None, (known[each].slot.notes for each in wanted)):
            say(f"note: {each}", err=True)
        raise typer.Exit(any(known[each].verdict != "ok" for each in wanted))


def read(results: Path) -> dict[str, Checked]:
    """Results in the file, by environment id. Skips truncated lines, so that those environments are played again."""
    by_env: dict[str, Checked] = {}
    data = read_given(results, f"--results {results}") if results.exists() else b""
    for line in data.splitlines():
        try:
            checked = msgspec.json.decode(line, type=Checked)
        except msgspec.MsgspecError:
            continue
        by_env[checked.here.env] = checked
    return by_env


def page(results: Path | None, earlier: str = "", ids: Sequence[str] | None = None) -> str:
    """A Markdown table of the results in a file, with the number of environments played. `earlier`: a text whose rows
    stay where the file has none. `ids`: the environments, in order; by default the catalogue's."""
    rows, times = tables(earlier)
    for env, each in (read(results) if results else {}).items():
        cells = list(each.cells())
        times[env] = (*cells[TIMES],)
        del cells[TIMES]
        rows[env] = (*cells[1:],)
    columns = list(COLUMNS)
    del columns[TIMES]
    head = [f"| {' | '.join(columns)} |", "|---|--:|--:|---|---|---|--:|--:|---|"]
    ids = list(catalogue.entries()) if ids is None else ids
    body = [f"| `{each}` | {' | '.join(rows[each])} |" for each in ids if each in rows]
    lines = [f"{len(body):,} of {len(ids):,} environments have been played.", "", *head, *body]
    if measured := [each for each in ids if any(times.get(each, ()))]:
        lines += ["", f"Processor times of a step were measured for {len(measured):,} of {len(ids):,}:", ""]
        lines += [f"| environment | {' | '.join(COLUMNS[TIMES])} |", "|---|--:|--:|"]
        lines += [f"| `{each}` | {' | '.join(times[each])} |" for each in measured]
        spans = (span(column) for column in zip(*(times[each] for each in measured), strict=True))
        lines += [f"| minimum, median, maximum | {' | '.join(spans)} |"]
    return "\n".join(lines) + "\n"


def tables(text: str) -> tuple[dict[str, tuple[str, ...]], dict[str, tuple[str, ...]]]:
    """The rows of pages without their ids, by environment id: of what was played, and both processor times, µs."""
    rows = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("| `")]
    n_times = TIMES.stop - TIMES.start
    played, times = (
        {row[0].strip(" `"): tuple(map(str.strip, row[1:])) for row in rows if len(row) == 1 + n}
        for n in (len(COLUMNS) - 1 - n_times, n_times)
    )
    return played, times


def span(times: Sequence[str], per: float = 1.0) -> str:
    """Minimum, median, and maximum of a column of times, in units of `per` µs, or the only one; `*` if one has it."""
    known = [float(each.strip("*").replace(",", "")) / per for each in times if each]
    mark = "*" if any("*" in each for each in times) else ""
    spread = (min, statistics.median, max) if len(known) > 1 else (max,)
    return ", ".join(_digits(f(known)) + mark for f in spread) if known else "-"


def _digits(value: float) -> str:
    return f"{value:,.3g}" if value < 100 else f"{value:,.0f}"
