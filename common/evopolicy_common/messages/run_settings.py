"""The settings with which an operator opens a run, and those of the published protocol."""

from __future__ import annotations

from typing import Literal

import msgspec

from evopolicy_common.catalogue import Suite
from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.bounds import Int, Named, Text, Word
from evopolicy_common.messages.environment import StepLimit
from evopolicy_common.messages.episode import ResourceLimits, Tier
from evopolicy_common.messages.gateway import Conditions, VideoOption

HiddenIsolation = Literal["exclusive", "shared", "waived", "unknown"]
"""Whether hidden episodes and agents could share a kernel. exclusive: never. shared: possible. waived: the
operator vouched for where the agent was. unknown: from before this was recorded."""

HiddenCases = Literal["shared", "per_run"]
"""Validation and held-out cases: the same for all runs of an environment, or each run's own (no paired statistics)."""

MAX_BUDGET = 20_000
MAX_EPISODES_PER_SUBMIT = 10_000
MAX_HIDDEN = 10_000
"""Validation or held-out cases of a run. The report of a finished run must fit into one message."""
ELSEWHERE = "elsewhere"
"""Value of `RunSettings.agent_host`: the operator vouches that the agent is on no machine of the cluster."""


_BY_STRENGTH = {
    "jail": ("bwrap", "bwrap, open network", "unknown", "none"),
    "sandbox_tier": ("bwrap", "landlock", "unknown", "none"),
    "metering": ("nothing", "relay", "unknown", "agent"),
}
"""Values of `Line`, the strongest first; any other counts as `unknown`."""


class Line(msgspec.Struct, frozen=True, kw_only=True):
    """The weakest conditions of a line of runs, each of which starts from the one before. `unknown`: a run has not told
    them."""

    jail: Word = "unknown"
    """As in `run.json`."""
    sandbox_tier: Word = "unknown"
    metering: Word = "unknown"
    """By whom tokens were counted: `relay`, `agent`, or `nothing` without a model."""

    def weakest(self, other: Line) -> Line:
        """The weaker condition of both, each in turn."""

        def weaker(name: str, order: tuple[str, ...]) -> str:
            values = (getattr(self, name), getattr(other, name))
            return order[max(order.index(each if each in order else "unknown") for each in values)]

        return Line(**{name: weaker(name, order) for name, order in _BY_STRENGTH.items()})


def metering_of(counted_by: str | None, model: str | None) -> str:
    """`Line.metering` of a run. `counted_by`: `agent.model_use.metering`, None without; `model`: that of the agent."""
    return counted_by or ("unknown" if model else "nothing")


class Start(msgspec.Struct, frozen=True, kw_only=True):
    """The submit of an earlier run from whose workspace a run starts."""

    run: Word
    """The coordinator's name of that run."""
    submit_index: Int
    tree: Word
    """SHA-256, hex, of the recorded workspace."""
    parent_scored: bool = False
    """The earlier agent had ended, so that a result may have chosen the place."""
    line: Line = Line()
    """The weakest conditions of the runs before. `unknown` while one of their agents is alive."""

    @property
    def text(self) -> str:
        return f"submit {self.submit_index} of {self.run}"


class AllConditions(Conditions, frozen=True, kw_only=True):
    """The conditions of a run with those that its gateway is not told."""

    step_limit: StepLimit = "natural"
    """Step limit: the published software's, or the environment's own."""
    hidden_cases: HiddenCases = "shared"


class RunSettings(AllConditions, frozen=True, kw_only=True):
    """Settings with which a run is opened. None means the suite's own number."""

    env: Word
    entry: Word
    """Name of the agent in tables, such as `evolve` or `GPT-5.5 (Codex)`."""
    model: Word
    exp_id: Word
    repeat: Int = 0
    attempt: Int = 1
    budget: Int | None = None
    min_episodes_per_submit: Int | None = None
    max_episodes_per_submit: Int | None = None
    n_validation: Int | None = None
    n_heldout: Int | None = None
    sandbox_tier: Tier = "bwrap"
    replays: VideoOption | None = None
    """Which held-out episodes of the selected checkpoint are recorded as video for people; None: as `video`."""
    limits: ResourceLimits = ResourceLimits()
    notes: Named[Text] = {}
    """The operator's own labels, such as the name of a sweep; kept in the coordinator's database, not in `run.json`."""
    agents_md: Word = ""
    """SHA-256, hex, of the operator's text in place of `AGENTS.md`; empty: the standard text."""
    prompts: Word = ""
    """SHA-256, hex, of the operator's prompts; empty: the standard ones."""
    inputs: Word = ""
    """SHA-256, hex, of the skills and MCP servers that the operator gives to the agent; empty: none."""
    definition: Word = ""
    """First digits of the digest of the environment's definition; empty: the definition that ships or is approved."""
    agent_host: Word = ""
    """Boot id of the agent's kernel, or `ELSEWHERE`; empty: the gateway's own kernel, or unknown for a remote agent."""
    start: Start | None = None
    """None: the run starts with the usual workspace."""
    replay_of: Word = ""
    """The coordinator's name of the run whose agent is played again; empty: a run of its own."""

    @property
    def recorded_heldout(self) -> VideoOption:
        """Which held-out episodes are recorded as video."""
        return self.video if self.replays is None else self.replays


PUBLISHED: dict[str, str] = {
    "policy_scope": "submit",
    "observations": "lists",
    "simulation": "forbidden",
    "finish": "budget",
    "step_limit": "published",
    "hidden_cases": "shared",
    "feedback": "pictures",
    "failed_episodes": "end-submit",
    "hidden_evaluation": "pool",
}
"""The settings of the published profiles, by their names in `RunSettings`. Its cases are the published files."""
HIDDEN_COUNTS: dict[str, tuple[int, int]] = {"published": (16, 32), "published-data": (64, 256)}
"""Validation and held-out cases by published profile: those of the paper, and those of the published case files."""
PUBLISHED_TRAIN = 1024
"""Number of train ids in the published case files."""


def off_profile(settings: RunSettings) -> str:
    """The settings in which a run of a published profile differs from the profile, in words; empty when none does."""
    if settings.profile == "own":
        return ""
    n_validation, n_heldout = HIDDEN_COUNTS[settings.profile]
    fixed = {**PUBLISHED, "n_validation": n_validation, "n_heldout": n_heldout}
    values = {name: getattr(settings, name) for name in fixed}
    if settings.start is not None:
        return "a start from a submit"
    return ", ".join(
        f"{name} {values[name]} (not {value})" for name, value in fixed.items() if values[name] != value
    )


def episode_counts(settings: RunSettings, suite: Suite) -> tuple[int, int, int]:
    """Budget, least and most episodes of a submit. Raises ConfigError for impossible numbers."""

    names = ("budget", "min_episodes_per_submit", "max_episodes_per_submit")
    given = {name: getattr(settings, name) for name in names}
    budget, least, wanted = (getattr(suite, name) if given[name] is None else given[name] for name in names)
    most = min(wanted, budget)
    if not 1 <= least <= most:
        raise ConfigError(
            f"a budget of {budget} episodes and submits of {least} to {wanted} episodes allow no submit; give a budget"
            f" of at least {max(least, 1)}, or other numbers of episodes in a submit"
        )
    for what, n, limit in (
        ("a budget", budget, MAX_BUDGET),
        ("submits", most, MAX_EPISODES_PER_SUBMIT),
        ("validation", settings.n_validation or 0, MAX_HIDDEN),
        ("held-out", settings.n_heldout or 0, MAX_HIDDEN),
    ):
        if n > limit:
            raise ConfigError(f"{what} of {n:,} episodes; {limit:,} are the limit")
    return budget, least, most
