"""Settings that must agree within one comparison: budgets, policy scopes, splits, fingerprints, the agents'
confinement, and whether hidden episodes and agents shared a kernel.

Settings of `_BY_SUITE`, among them each field of `AllConditions`, must agree over all runs of a suite, those of
`_BY_ENTRY` over the runs of one entry, and those of `_BY_ENVIRONMENT` and the library fingerprint over the runs of one
environment, since environments differ in them anyway. Runs with hidden cases of their own differ in these splits by
design. Of a fingerprint's `adapter` (`REVISION+DIGEST`) the revision counts; the digest, and that of all of the
worker's code, only distinguish workers within a run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import NamedTuple

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import EvopolicyError
from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.run_settings import AllConditions
from evopolicy_common.records.run_record import inputs_digest
from evopolicy_common.terminal import counted
from evopolicy_results.reading.environments import grouped, ordered_environments, suites_of
from evopolicy_results.reading.records import PastRun, path_text

_CODE = "evopolicy-worker"


def comparable(fingerprints: Sequence[Mapping[str, str]]) -> list[dict[str, str]]:
    """The relevant parts of fingerprints, in order; runs with equal dicts are comparable."""
    compared = [dict(each) for each in fingerprints]
    for parts in compared:
        if "adapter" in parts:
            del parts[_CODE]
            parts["adapter"] = parts["adapter"].partition("+")[0]
    return compared


class Mixture(msgspec.Struct, frozen=True, kw_only=True):
    """One setting in which compared runs differ."""

    what: str
    """`episode budget`, `policy scope`, `train split`, …"""
    where: str
    """Suite or environment."""
    values: dict[str, int]
    """Each value as text, to the number of runs with it."""
    folders: dict[str, tuple[str, ...]] = {}
    """Each value to the folders of the runs with it; empty if the runs have none, or the value names its run."""

    def __str__(self) -> str:
        counts = ", ".join(f"{value} ({counted(n, 'run')})" for value, n in self.values.items())
        return f"{self.what} on {self.where}" + (f": {counts}" if counts else "")


class MixedRunsError(EvopolicyError):
    """The runs are not a fair comparison; `mixtures` lists the differences."""

    def __init__(self, mixtures: Sequence[Mixture]) -> None:
        super().__init__("\n".join(["these runs cannot be compared:", *_named(mixtures)]))
        self.mixtures = tuple(mixtures)


_MOST_NAMED = 5
"""Of the values of a setting, and of the runs of a value, in an error."""


def _named(mixtures: Sequence[Mixture]) -> Iterator[str]:
    """Lines with the differences, and with the folders of the runs where another difference has not named them."""
    told: dict[frozenset[tuple[str, ...]], Mixture] = {}
    for mixture in mixtures:
        yield f"  {mixture}"
        first = told.setdefault(frozenset(mixture.folders.values()), mixture)
        if first is not mixture and mixture.folders:
            yield f"    the same runs as for the {first.what}"
            continue
        for value, folders in islice(mixture.folders.items(), _MOST_NAMED):
            more = len(folders) - _MOST_NAMED
            yield f"    {value}: {', '.join(folders[:_MOST_NAMED])}" + f" and {more} more" * (more > 0)
        if (more := len(mixture.folders) - _MOST_NAMED) > 0:
            yield f"    and {more} more values"


UNKNOWN_ISOLATION = "hidden isolation, which some runs do not record,"
"""Runs without this record, such as those of the published software, beside runs with it."""


class _Setting(NamedTuple):
    """A setting in which compared runs have to agree."""

    of: Callable[[PastRun], str]
    remedy: str = ""
    """How to play runs that agree in it; empty where no option decides it."""
    concerns: Callable[[PastRun], object] = lambda run: True
    """Other runs may stand beside those that it concerns."""


def _dimension(name: str, option: str) -> _Setting:
    return _Setting(lambda run: str(getattr(run.record.experiment_dimensions, name)), f"the same --{option}")


def _split(split: Split) -> _Setting:
    def of(run: PastRun) -> str:
        if split != "train" and run.record.experiment_dimensions.hidden_cases == "per_run":
            return "its own"
        return _short(run.record.versions.cases_hash(split))

    return _Setting(
        of, "the same cases (one --state or --data for all, none with --fresh, all in the same --jail)"
    )


def _short(digest: str) -> str:
    return digest.removeprefix("sha256:")[:12]


def _step_limit(run: PastRun) -> str:
    """Empty if the environment has only one limit."""
    entry = catalogue.entries().get(run.env)
    both = entry is not None and entry.published_steps is not None
    return run.record.experiment_dimensions.step_limit if both else ""


def _limits(holder: object) -> str:
    """Its limits as `name=value` words; empty if the run has no record of them."""
    limits = getattr(holder, "limits", None)
    given = {} if limits is None else msgspec.to_builtins(limits)
    return " ".join(f"{name}={value}" for name, value in given.items() if value is not None)


_WORDS = {
    "observations": "observation form",
    "simulation": "simulation rule",
    "finish": "finish rule",
    "feedback": "feedback detail",
}
"""Names of conditions in messages, where they differ from the field's."""
_OPTIONS = {"hidden_evaluation": "profile"}
"""Options that decide a condition, where they differ from the field's name."""
_IN_ENVIRONMENT = ("video", "step_limit")
_BY_SUITE = {
    "episode budget": _dimension("episode_budget", "budget"),
    **{
        _WORDS.get(name, name.replace("_", " ")): _dimension(name, _OPTIONS.get(name, name.replace("_", "-")))
        for name in AllConditions.__struct_fields__
        if name not in _IN_ENVIRONMENT
    },
    "text of AGENTS.md": _Setting(
        lambda run: _short(run.record.experiment_dimensions.agents_md) or "standard", "the same agents_md"
    ),
    "jail": _Setting(lambda run: run.record.line.jail, "the same --jail"),
    "hidden isolation": _Setting(
        lambda run: run.record.hidden_isolation, concerns=lambda run: run.record.hidden_isolation != "unknown"
    ),
    UNKNOWN_ISOLATION: _Setting(lambda run: run.record.hidden_isolation),
    "model limits": _Setting(
        lambda run: _limits(run.record.agent.model_use),
        "the same max_requests, max_tokens, and max_cost in the agents' files",
        lambda run: run.record.agent.model_use is not None,
    ),
    "agent limits": _Setting(
        lambda run: _limits(run.record.agent.resources),
        "the same agent_cpus, agent_memory, agent_pids, and agent_disk, on machines that can keep them",
        lambda run: run.record.agent.resources is not None,
    ),
}
_BY_ENTRY = {
    "prompts": _Setting(
        lambda run: _short(run.record.agent.prompts) or "standard",
        "the same prompts, or another --entry for each",
    ),
    "skills and MCP servers": _Setting(
        lambda run: inputs_digest(run.record.agent.inputs)[:12],
        "the same `skills` and `[mcp]` in the agent's file, or another --entry for each",
    ),
}
_BY_ENVIRONMENT = {
    "train split": _split("train"),
    "validation split": _split("validation"),
    "held-out split": _split("heldout"),
    "environment version": _Setting(lambda run: run.record.versions.env),
    "episodes a submit": _Setting(lambda run: run.submit_size, "the same min_episodes and max_episodes"),
    "policy limits": _Setting(lambda run: _limits(run.record.experiment_dimensions), "the same --limit"),
    "step limit": _Setting(_step_limit, "the same step_limit"),
    "videos in feedback": _dimension("video", "video"),
}
REMEDIES = {
    what: setting.remedy
    for what, setting in (_BY_SUITE | _BY_ENTRY | _BY_ENVIRONMENT).items()
    if setting.remedy
}
"""By `Mixture.what`: how to play runs that agree in it."""


def mixtures(runs: Iterable[PastRun]) -> list[Mixture]:
    """Every difference between runs of one suite or environment; empty for a fair comparison."""
    by_env = grouped(runs, lambda run: run.env)
    out: list[Mixture] = []
    for suite, envs in suites_of(by_env).items():
        together = [run for env in envs for run in by_env[env]]
        out += _differences(_BY_SUITE, suite, together)
        for entry, own in sorted(grouped(together, lambda run: run.entry).items()):
            out += _differences(_BY_ENTRY, f"{suite}, {entry}", own)
    for env in ordered_environments(by_env):
        fingerprint = {"fingerprint": _Setting(_fingerprint_beside(by_env[env]))}
        out += _differences(_BY_ENVIRONMENT | fingerprint, env, by_env[env])
    return out


def _fingerprint_beside(runs: list[PastRun]) -> Callable[[PastRun], str]:
    """A function for the parts of a run's fingerprint that differ among `runs`, and the operator's overrides."""
    compared = comparable([run.record.versions.fingerprint for run in runs])
    items = {id(run): set(parts.items()) for run, parts in zip(runs, compared, strict=True)}
    common = set.intersection(*items.values())

    def beside(run: PastRun) -> str:
        versions = run.record.versions
        words = [f"{k}={v}" for k, v in sorted(items[id(run)] - common)]
        return " ".join([*words, *(f"then {each}" for each in versions.fingerprint_overrides)])

    return beside


def _differences(settings: dict[str, _Setting], where: str, runs: list[PastRun]) -> list[Mixture]:
    out: list[Mixture] = []
    for what, setting in settings.items():
        by_value: dict[str, list[str]] = {}
        for run in filter(setting.concerns, runs):
            by_value.setdefault(setting.of(run) or "none", []).append(path_text(run.path))
        if len(by_value) > 1 and (what != UNKNOWN_ISOLATION or "unknown" in by_value):
            folders = {value: tuple(those) for value, those in sorted(by_value.items())}
            counts = {value: len(those) for value, those in folders.items()}
            out.append(Mixture(what=what, where=where, values=counts, folders=folders))
    return out
