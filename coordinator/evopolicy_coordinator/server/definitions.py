"""Decides which definitions of environments a cluster plays.

A worker could announce an easier definition, or a task text that prompts agents.

Rules that this module owns:
- An environment that ships is accepted in its shipped definition only. Other announcements are ignored, and the
  worker is notified.
- Any other environment needs the operator's approval of its definition: with the request (`ID@DIGEST`), or
  permanently (`approve`, stored in the state folder).
- A coordinator that trusts its workers, such as that of a local command, accepts their announcements.
- The texts of a definition are bounded and have no unprintable characters. So are those that its digest does not cover.
- The size of a description is bounded in any case: every state of a run has it, and a gateway gets it in one message.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import msgspec

from evopolicy_common import catalogue
from evopolicy_common.errors import RefusedError
from evopolicy_common.messages.environment import EnvironmentDescription
from evopolicy_common.messages.operator import OfferedEnvironment
from evopolicy_common.messages.worker import DEFINITION_DIGITS
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.refusals import Refusal
from evopolicy_coordinator.core.tables.model import Worker

MAX_TEXT = 64 << 10
MAX_SPACE_BYTES = 1 << 20
MAX_DESCRIPTION_BYTES = 4 << 20
MAX_PACKAGES_BYTES = 64 << 10
MAX_LINE = 1000
MAX_NAME = 120
LEAST_DIGITS = 8
"""Minimum length of a digest that an operator names, hex digits."""


class Definitions:
    """The accepted definitions, and those that the operator has approved."""

    def __init__(
        self, file: Path | None = None, *, shipped: Mapping[str, str] | None = None, trusting: bool = True
    ) -> None:
        """`file`: where approvals are stored; None: not stored. `shipped`: by environment id, the first digits of its
        definition's digest."""
        self._file = file
        self._shipped = shipped or {}
        self._trusting = trusting
        self.approved: dict[str, list[str]] = {}
        """By environment, the definitions that the operator has approved, the latest last."""
        if file is not None and file.exists():
            self.approved = msgspec.json.decode(file.read_bytes(), type=dict[str, list[str]])

    def admit(
        self, announced: Iterable[EnvironmentDescription]
    ) -> tuple[tuple[EnvironmentDescription, ...], dict[str, str]]:
        """Returns the accepted descriptions, and by environment the reason why another is refused."""
        refused = {each.env: why for each in announced if (why := self._fault(each))}
        return tuple(each for each in announced if each.env not in refused), refused

    def _fault(self, description: EnvironmentDescription) -> str:
        if fault := _too_large(description):
            return fault
        if self._trusting:
            return ""
        if fault := _unreadable(description):
            return f"its {fault}"
        digest = digits(description)
        shipped = self._shipped.get(description.env)
        if shipped is not None and digest != shipped:
            return (
                f"it ships with definition {shipped}, and the worker's is {digest}: install the same version of"
                " evopolicy and of the environment's packages on both"
            )
        if shipped is None and not description.adapter:
            return "its description names no adapter: install the same version of evopolicy on coordinator and worker"
        return ""

    def pin(self, env: str, requested: str, workers: Iterable[Worker]) -> str:
        """Returns the definition that a run or an evaluation of `env` is played in; empty: any accepted one.

        `requested`: the first digits of the digest that the operator named. Raises RefusedError, with similar names and
        the remedy, when no worker offers it or the operator has not approved it.
        """
        if self._trusting and not requested:
            return ""
        workers = tuple(workers)
        offers = _offers(env, workers)
        if requested:
            return self._named(env, requested, offers)
        if catalogue.is_shipped(env) and env in self._shipped:
            return ""
        if not offers:
            if on := failed(workers).get(env):
                why = "; ".join(f"{name}: {text}" for name, text in on.items())
                raise RefusedError(Refusal.INVALID_SETTINGS, f"no worker offers {env}; it failed on {why}")
            known = {name for each in workers for name in each.profile.descriptions}
            raise RefusedError(
                Refusal.INVALID_SETTINGS,
                f"no worker offers {env}{catalogue.near(env, sorted(known))}; install its package on a worker and start"
                " that with --env; `evopolicy envs` lists the offered ones",
            )
        approved = [each for each in reversed(self.approved.get(env, [])) if each in offers]
        if approved:
            return approved[0]
        named = ", ".join(f"{env}@{each}" for each in offers)
        raise RefusedError(
            Refusal.INVALID_SETTINGS,
            f"{env} does not ship with evopolicy, and its definition is not approved; workers offer {named}. Inspect it"
            f" with `evopolicy envs --env {env}`, then give this name to --env, or approve it once: `evopolicy envs"
            f" approve {env}@{offers[0]}`",
        )

    def _named(self, env: str, requested: str, offers: list[str]) -> str:
        if len(requested) < LEAST_DIGITS or not all(each in "0123456789abcdef" for each in requested):
            raise RefusedError(
                Refusal.INVALID_SETTINGS,
                f"{env}@{requested[:80]}: a definition's digest has {LEAST_DIGITS} hex digits or more, as `evopolicy"
                " envs` shows it",
            )
        matching = [each for each in offers if each.startswith(requested) or requested.startswith(each)]
        if len(matching) == 1:
            return matching[0]
        if self._trusting and not offers:  # its worker is about to register
            return requested[:DEFINITION_DIGITS]
        offered = ", ".join(offers) or "none"
        raise RefusedError(
            Refusal.INVALID_SETTINGS,
            f"no worker offers {env} in definition {requested}; offered are: {offered}",
        )

    def approve(self, env: str, requested: str, workers: Iterable[Worker]) -> None:
        """Approves a definition and stores the approval. Raises RefusedError when no worker offers it."""
        digest = self._named(env, requested, _offers(env, workers))
        kept = [each for each in self.approved.get(env, []) if each != digest]
        self.approved[env] = [*kept, digest]
        if self._file is not None:
            data = msgspec.json.format(msgspec.json.encode(self.approved, order="sorted"))
            write_atomically(self._file, data, mode=0o600)

    def offered(self, workers: Iterable[Worker]) -> list[OfferedEnvironment]:
        """Every definition of every environment that connected workers offer."""
        offering: dict[tuple[str, str], tuple[EnvironmentDescription, list[str]]] = {}
        for worker in _connected(workers):
            for env, description in worker.profile.descriptions.items():
                key = (env, digits(description))
                _, names = offering.get(key, (description, []))
                offering[key] = description, [*names, worker.name]
        return [
            OfferedEnvironment(
                description=description,
                digest=digest,
                accepted=self._word(env, digest),
                workers=tuple(names),
            )
            for (env, digest), (description, names) in sorted(offering.items(), key=lambda each: each[0])
        ]

    def _word(self, env: str, digest: str) -> str:
        if env in self._shipped:
            return "ships"
        if self._trusting:
            return "trusted"
        return "approved" if digest in self.approved.get(env, []) else "by digest only"


def _connected(workers: Iterable[Worker]) -> Iterator[Worker]:
    return (each for each in workers if each.state != "lost")


def _offers(env: str, workers: Iterable[Worker]) -> list[str]:
    """The distinct definitions of an environment that workers have described."""
    profiles = [each.profile for each in workers if env in each.profile.descriptions]
    return list(dict.fromkeys(each.fingerprints[env].definition or "unknown" for each in profiles))


def undescribed(workers: Iterable[Worker]) -> dict[str, tuple[str, ...]]:
    """By environment that no connected worker has described yet, the workers that will."""
    offering: dict[str, list[str]] = {}
    described: set[str] = set()
    for worker in _connected(workers):
        described |= worker.profile.descriptions.keys()
        for env in worker.undescribed:
            offering.setdefault(env, []).append(worker.name)
    return {env: tuple(sorted(offering[env])) for env in sorted(offering.keys() - described)}


def failed(workers: Iterable[Worker]) -> dict[str, dict[str, str]]:
    """By environment, the connected workers on which it failed, with the reasons."""
    failures: dict[str, dict[str, str]] = {}
    for worker in _connected(workers):
        for env, why in worker.failed_environments.items():
            failures.setdefault(env, {})[worker.name] = why
    return dict(sorted(failures.items()))


def digits(description: EnvironmentDescription) -> str:
    """The shortened digest of a definition, as shown to people."""
    return description.digest()[:DEFINITION_DIGITS]


def _unreadable(description: EnvironmentDescription) -> str:
    """Describes a part that is too large or unprintable; empty when there is none."""
    components = (*description.reward_components, *description.reward_texts, *description.reward_weights)
    parts: list[tuple[str, int, str, Iterable[str]]] = [
        ("task text", MAX_TEXT, "\n\t", (description.task_text,)),
        ("title", MAX_NAME, "", (description.title,)),
        ("family", MAX_NAME, "", (description.family,)),
        ("key of success", MAX_NAME, "", (description.success,)),
        ("list of reward components", MAX_NAME, "", components),
        *(
            (f"text of {name[:40]!r}", MAX_LINE, "\n\t", (text,))
            for name, text in description.reward_texts.items()
        ),
        ("version", MAX_LINE, "", (description.env_version,)),
        ("adapter", MAX_LINE, "", (description.adapter,)),
        ("list of packages", MAX_LINE, "", (*description.packages, *description.packages.values())),
    ]
    for name, most, also, texts in parts:
        for text in texts:
            if len(text) > most:
                return f"{name} has {len(text):,} characters; {most:,} are the limit"
            if not all(each.isprintable() or each in also for each in text):
                return f"{name} has characters that cannot be seen; write it without control characters"
    if not catalogue.valid_id(description.env):
        return "id is not one: letters, digits, '_', '.', '-', parts joined by '/' or ':'"
    return ""


def _too_large(description: EnvironmentDescription) -> str:
    """Describes a part that is too large, or the whole; empty when there is none."""
    parts = {
        "obs_space": (description.obs_space, MAX_SPACE_BYTES),
        "action_space": (description.action_space, MAX_SPACE_BYTES),
        "definition": (description.definition, MAX_SPACE_BYTES),
        "list of packages": (description.packages, MAX_PACKAGES_BYTES),
        "description": (description, MAX_DESCRIPTION_BYTES),
    }
    for name, (part, most) in parts.items():
        size = len(msgspec.msgpack.encode(part))
        if size > most:
            return f"its {name} takes {size:,} bytes; {most:,} are the limit"
    return ""
