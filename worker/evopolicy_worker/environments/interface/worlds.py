"""The environments of `evopolicy_common.worlds`: any environment under the rules that its cases tell."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.catalogue.worlds import KEY, OPTION
from evopolicy_common.errors import WorkerError
from evopolicy_common.messages.environment import Case
from evopolicy_common.worlds import rules
from evopolicy_common.worlds.rules import FACTORS, PUBLIC, Rules, kinds, text
from evopolicy_worker.environments.interface.base import Environment, Frame, Observation, Step
from evopolicy_worker.environments.interface.fingerprint import adapter

_CODE = hashlib.sha256(Path(rules.__file__).read_bytes()).hexdigest()[:12]


class World(Environment):
    """A world of `base`, whose cases tell its rules."""

    def __init__(self, env_id: str, title: str, base: Environment) -> None:
        self._base = base
        described = base.description
        self._given = described.obs_space, described.action_space, base.parameters
        possible = kinds(*self._given)
        definition = {**described.definition, "world": env_id.rpartition("@")[2]}
        if base.parameters:
            definition["parameters"] = {name: [min(FACTORS), max(FACTORS)] for name in base.parameters}
        self.description = msgspec.structs.replace(
            described,
            env=env_id,
            title=title,
            task_text=described.task_text.rstrip() + text(possible, base.parameters) + "\n",
            definition=definition,
            adapter=f"{described.adapter}/{adapter(World, 1, '')}/{_CODE}",
        )
        self.action_codec = base.action_codec
        self.solved_by = base.solved_by
        self.rebuilds = base.rebuilds
        self._rules: tuple[str, Rules] | None = None

    def reset(self, case: Case) -> Observation:
        options = dict(case.options or {})
        key = options.pop(OPTION, PUBLIC)
        if not (isinstance(key, str) and KEY.fullmatch(key)):
            raise WorkerError(
                f"{self.description.env}: a case has no valid key of its world; its options need {OPTION!r} with 32"
                " hexadecimal digits, or these, a hyphen, and a candidate's number"
            )
        if self._rules is None or self._rules[0] != key:
            self._rules = key, Rules(key, *self._given)
            self._base.alter(self._rules[1].factors)
        return self._rules[1].observe(self._base.reset(Case(seed=case.seed, options=options or None)))

    def step(self, action: Any) -> Step:
        assert self._rules is not None
        rules = self._rules[1]
        step = self._base.step(rules.act(action))
        return step._replace(obs=rules.observe(step.obs))

    def render(self) -> Frame:
        return self._base.render()

    def close(self) -> None:
        self._base.close()
