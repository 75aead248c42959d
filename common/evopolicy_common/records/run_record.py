"""`run.json`: the typed record of a run.

The run's finaliser writes it; reports and `verify` read it. It is written once and last, after the agent and its
children have ended, because it holds hidden scores. It has the published fields in their published meaning, and more.
Readers skip unknown fields, and a field added later has a default; a file with another `record_version` than ours is
refused. Paths are relative to the run directory. Times are UTC texts as `summary.utc_text` writes them; durations are
seconds.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any, Literal

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError, raised_as
from evopolicy_common.messages.bounds import check_plausible
from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.episode import ResourceLimits, Tier
from evopolicy_common.messages.operator import Committed, RunEnd
from evopolicy_common.messages.run_settings import AllConditions, HiddenIsolation, Line, Start, metering_of
from evopolicy_common.records.code_metrics import PUBLISHED_SCHEMA
from evopolicy_common.records.model_record import Level

RECORD_VERSION = 5
"""Version of our own fields. Incremented only when older readers would misunderstand a file, not for added fields."""

PROTOCOL_VERSION = "protocol/v2.0-draft"
"""The agent-facing protocol that runs follow."""


class Tokens(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Tokens of the whole run, as the paper's appendix defines them."""

    input_noncached: int
    """Input tokens not served from a cache."""
    cache_read: int
    cache_creation: int
    output: int
    """Output tokens, including reasoning."""
    reasoning: int | None = None
    """Reasoning tokens within `output`; None if unreported."""
    cost: float | None = None
    """Cost in US dollars; None without prices."""

    @property
    def total(self) -> int:
        """All kinds together."""
        return self.input_noncached + self.cache_read + self.cache_creation + self.output


class ModelLimits(msgspec.Struct, frozen=True, kw_only=True):
    """Limits of a run's use of its model."""

    max_requests: int
    max_tokens: int
    """All kinds together."""
    max_cost: float | None = None
    """US dollars."""


class ModelUse(msgspec.Struct, frozen=True, kw_only=True):
    """How the agent used its model, besides `tokens`."""

    metering: Literal["relay", "agent"]
    """`relay`: the relay counted every request and had the key. `agent`: the agent's own count; the following fields
    are unknown."""
    limits: ModelLimits | None = None
    """None: this software sets none."""
    requests: int | None = None
    """Requests that went to the provider."""
    requests_failed: int = 0
    """Of these, requests without a whole answer."""
    requests_estimated: int = 0
    """Requests with an estimated count: the answer broke off or had no valid count."""
    models: dict[str, int] = {}
    """Requests by the model that the answer names."""
    other_models: dict[str, int] = {}
    """Requests for other models than `model_string`, by model."""
    hosted_tools: dict[str, int] = {}
    """Requests that offer a tool of the provider, by its kind, such as `web_search`."""
    first_token_s: float | None = None
    """Mean time to the first bytes of an answer."""
    rate_limit_s: float = 0.0
    """Sum of the times for which the provider asked to wait."""
    record: Level | None = None
    """How much of its calls is in `logs/model/`; None if the relay did not count."""
    record_stopped: str = ""
    """Why the record ends before the run; empty where it does not."""
    reported: Tokens | None = None
    """The agent's own count, in addition to the relay's."""

    def difference(self, tokens: Tokens | None) -> float | None:
        """How far the agent's own count is from `tokens`, as a share of these; None where one is unknown."""
        if tokens is None or self.reported is None or not tokens.total:
            return None
        return abs(self.reported.total - tokens.total) / tokens.total


class AgentLimits(msgspec.Struct, frozen=True, kw_only=True):
    """Limits of an agent's use of its machine. None: unlimited."""

    cpus: float | None = None
    """Processor time in cores."""
    memory_bytes: int | None = None
    pids: int | None = None
    """Processes and threads at once."""
    disk_bytes: int = 20_000_000_000
    """Space of its workspace without feedback, its home and /tmp."""


class AgentResources(msgspec.Struct, frozen=True, kw_only=True):
    """An agent's share of its machine."""

    limits: AgentLimits
    """None: a limit that this machine could not enforce."""
    kept_by: dict[str, str] = {}
    """`cgroup v1`, `cgroup v2`, `affinity` or `rlimit`, by name of the limit."""
    cpu_s: float = 0.0
    """Processor time of all its programs, seconds."""
    memory_peak_bytes: int = 0
    """Peak memory: of the cgroup, with cached files, or sum of resident sizes every 5 s."""
    disk_bytes: int = 0
    """Most space of its files that was seen."""
    ended_for_memory: int = 0
    """Processes that the kernel ended at the memory limit."""
    refused_forks: int = 0
    """Processes refused at the limit of their number."""

    def after(self, before: AgentResources | None) -> AgentResources:
        """Together with what earlier programs of the agent used, whose limits were the same."""
        if before is None:
            return self
        return msgspec.structs.replace(
            self,
            cpu_s=round(before.cpu_s + self.cpu_s, 3),
            memory_peak_bytes=max(before.memory_peak_bytes, self.memory_peak_bytes),
            disk_bytes=max(before.disk_bytes, self.disk_bytes),
            ended_for_memory=before.ended_for_memory + self.ended_for_memory,
            refused_forks=before.refused_forks + self.refused_forks,
        )


PUBLISHED_SETTINGS = frozenset({"wall_limit_s", "silence_limit_s", "effort"})
"""Those of an agent's settings that are published: numbers and words of the project's own options."""


class AgentInput(msgspec.Struct, frozen=True, kw_only=True):
    """A skill or MCP server that the operator gave to the agent, read-only."""

    kind: Literal["skill", "mcp"]
    name: str
    digest: str
    """SHA-256 of its files, and of a server's command line, program and variables."""
    hosts: tuple[str, ...] = ()
    """Hosts that a server reaches; the agent's jail allowed them."""


def inputs_digest(inputs: Sequence[AgentInput]) -> str:
    """SHA-256, hex, of all inputs, in any order; empty without inputs."""
    listed = sorted((one.kind, one.name, one.digest, sorted(one.hosts)) for one in inputs)
    return hashlib.sha256(msgspec.json.encode(listed)).hexdigest() if listed else ""


class Agent(msgspec.Struct, frozen=True, kw_only=True):
    """The agent of the run: one leaderboard entry."""

    entry: str
    """Name of the leaderboard entry."""
    harness: str
    """`codex`, `claude-code`, `command`, `replay`, `evolve`, …"""
    cli_version: str | None = None
    model_string: str | None = None
    """The configured model, or the one that answered most; None without a model."""
    prompts: str = ""
    """SHA-256 (`sha256:…`) of the operator's prompts; empty: the standard ones."""
    inputs: tuple[AgentInput, ...] = ()
    """Skills and MCP servers that the operator gave to it."""
    settings: dict[str, Any] = {}
    """Other start settings: effort, extra arguments, retry base; no secrets."""
    retries: int = 0
    """Resumptions of the session after a provider's or harness's failure."""
    turns: int = 0
    tokens: Tokens | None = None
    """None when nothing counted them."""
    model_use: ModelUse | None = None
    """None for agents without a model."""
    resources: AgentResources | None = None
    """None for agents that were not started here."""


class ExperimentDimensions(AllConditions, frozen=True, kw_only=True):
    """The conditions and numbers that define the experiment; runs that differ here are not comparable."""

    episode_budget: int
    min_episodes_per_submit: int
    max_episodes_per_submit: int
    n_train: int
    n_validation: int
    n_heldout: int
    limits: ResourceLimits | None = None
    """None: unknown, as in runs of the published software."""
    agents_md: str = ""
    """SHA-256 (`sha256:…`) of the operator's text in place of `AGENTS.md`; empty: the standard text."""

    def n_cases(self, split: Split) -> int:
        return {"train": self.n_train, "validation": self.n_validation, "heldout": self.n_heldout}[split]


class Timing(msgspec.Struct, frozen=True, kw_only=True):
    """How the wall time was spent. The phases need not add up to `wall_time_seconds`."""

    start_time: str
    end_time: str
    wall_time_seconds: float
    """From the run's opening to `run.json`."""
    agent_s: float = 0.0
    """Only the agent worked: no submit was in flight."""
    queue_s: float = 0.0
    """A submit waited and none of its episodes ran."""
    rollout_s: float = 0.0
    """At least one train episode ran."""
    feedback_s: float = 0.0
    """From the last episode's result to the reply to the submit."""
    held_s: float = 0.0
    """A submit waited for hidden episodes; part of no phase, and counted against no limit."""
    permit_s: float = 0.0
    """The agent's start waited for hidden episodes of related runs; part of no phase."""
    finalise_s: float = 0.0
    """From the agent's end to `run.json`."""


class ReferenceScore(msgspec.Struct, frozen=True, kw_only=True):
    """The score of uniform random actions on this run's own held-out cases; equal in every run on the split."""

    mean_return: float
    std_return: float
    """Population standard deviation."""
    returns: tuple[float, ...] = ()


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """The result of the run. Every score except `final_score` is None unless `status` is `completed`."""

    status: RunEnd
    error: str | None = None
    """Why the status is `error` or `cancelled`, for the operator."""
    final_score: float | None = None
    """The held-out mean return, the paper's number. As published, 0.0 for `no_ok_submit`."""
    best_submit_index: int | None = None
    """Index of the submit of the selected checkpoint."""
    val_scores: dict[str, float] | None = None
    """Mean validation return of each eligible checkpoint, by submit index (decimal text)."""
    heldout_mean_return: float | None = None
    heldout_std_return: float | None = None
    """Population standard deviation."""
    heldout_returns: tuple[float, ...] = ()
    """In the order of the split's cases."""
    heldout_successes: tuple[bool, ...] = ()
    """Whether each of these episodes solved the task, as the environment reports it; empty where it reports nothing."""
    quarantined_submits: tuple[int, ...] = ()
    """`ok` checkpoints that are not eligible (`failed_episodes` = "end-submit"): their policy failed in
    validation."""
    random_reference: ReferenceScore | None = None
    closed_reason: str = ""
    """`budget_spent`, `agent_stopped`, `agent_failed`, `silent`, `wall_limit`, `model_budget_spent`,
    `disk_limit` or `cancelled`: why submits ended."""
    budget_used: int = 0
    """Episodes charged."""
    auxiliary: dict[str, Any] = {}
    """`code_metrics_best`, `code_metrics_by_submit` and `code_metrics_trend` as published, and our own counts."""

    @property
    def score(self) -> float | None:
        """The held-out mean return; None unless the run completed."""
        return self.final_score if self.status == "completed" else None

    @property
    def random_score(self) -> float | None:
        """The mean return of uniform random actions on the same cases; None when they were not played."""
        return None if self.random_reference is None else self.random_reference.mean_return

    @property
    def agent_never_played(self) -> bool:
        """Whether the agent failed before it used any budget, such as a CLI that did not start."""
        return (
            self.status == "no_ok_submit" and self.closed_reason == "agent_failed" and self.budget_used == 0
        )


RejectedStatus = Literal["budget_invalid", "invalid_env_instance", "run_closed"]


class RejectedSubmit(msgspec.Struct, frozen=True, kw_only=True):
    """A request that was refused before the snapshot and was not charged."""

    status: RejectedStatus
    message: str
    at: str = ""
    after_submits: int = 0
    """Number of accepted submits before it."""


class Replay(msgspec.Struct, frozen=True, kw_only=True):
    """A recorded episode: a video with one rendered frame per row."""

    path: str
    """`video.mp4` under the run directory, such as `replays/heldout_000/video.mp4`."""
    split: Split
    episode: int
    """Position in the split, from 0."""
    submit_index: int
    episode_return: float | None = None
    length: int | None = None
    """Number of steps."""
    filmstrip: str | None = None
    """A PNG with some of its frames side by side."""


class Artifacts(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Paths relative to the run directory; artifacts that this run lacks are omitted (None)."""

    workspace: str | None = None
    feedback: str | None = None
    checkpoints: str | None = None
    logs_harness: str | None = None
    logs_agent: str | None = None
    logs_env: str | None = None


class Versions(msgspec.Struct, frozen=True, kw_only=True):
    """Versions of the run's components. Hashes are `sha256:` and lowercase hex; empty where unknown."""

    harness: str
    """Version of this software."""
    env: str
    """Name and version of the simulated environment, such as `Acrobot-v1 (gymnasium 1.4.0)`."""
    agents_md_hash: str
    """Hash of `AGENTS.md` in the workspace, with this run's URLs."""
    data_train_hash: str
    """Hash of `train.json`; without a file, of the cases as canonical JSON."""
    data_valid_hash: str
    data_heldout_hash: str
    rules_hash: str = ""
    """Hash of `AGENTS.md` with placeholders for its URLs."""
    cases_hashes: dict[Split, str] = {}
    """Hashes of the run's cases as canonical JSON, by split."""
    fingerprint: dict[str, str] = {}
    """Library to version, from the workers with which the run started."""
    installations: tuple[str, ...] = ()
    """Installations that played the run's episodes, as `NAME@DIGEST`: families of `evopolicy-worker setup`, or
    `base`, and a hash of their packages."""
    fingerprint_overrides: tuple[str, ...] = ()
    """`CLASS → CLASS: why` for each `evopolicy runs repin`."""
    data_secret: bool = True
    """False when the splits derive from a small public seed."""
    initial_policy_hash: str | None = None
    """Hash of the initial `policy.py` of the workspace."""
    env_deterministic: bool = True
    """Whether seed and actions determine an episode."""

    def cases_hash(self, split: Split) -> str:
        """The hash that identifies a split's cases: `cases_hashes`, or the file's hash if that is missing."""
        return self.cases_hashes.get(split, self.file_hash(split))

    def file_hash(self, split: Split) -> str:
        """The hash of a split's case file; of its cases if there is none."""
        train, heldout = self.data_train_hash, self.data_heldout_hash
        return {"train": train, "validation": self.data_valid_hash, "heldout": heldout}[split]


class RunSummary(msgspec.Struct, frozen=True, kw_only=True):
    """One row per run."""

    run: str
    """Path of its folder."""
    env: str
    entry: str
    model: str
    exp_id: str
    repeat: int
    status: str
    """`completed`, `no_ok_submit`, `error` or `cancelled`."""
    score: float | None
    """Held-out mean return of the selected checkpoint; None without an ok submit."""
    random_score: float | None
    """Mean return of uniform random actions on the same cases; None when they were not played."""
    best_submit: int | None
    """Index of the selected submit, from 0; None unless the run completed."""
    budget: int
    """Train episodes."""
    budget_used: int
    """Used train episodes."""
    closed_reason: str
    """Why the agent's side ended, such as `budget_spent` or `agent_stopped`."""
    wall_s: float
    """Wall time from the run's opening to its end, seconds."""
    start: str
    """The submit of another run that it starts from; empty: the usual workspace."""


class RunRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The content of `run.json`."""

    schema_version: str = PUBLISHED_SCHEMA
    record_version: int = RECORD_VERSION
    protocol_version: str = PROTOCOL_VERSION
    model: str
    env: str
    """Suite id of the environment."""
    env_title: str = ""
    """Short name of the environment for tables; empty if no worker described it."""
    env_family: str = ""
    """Key of the family in which its scores are averaged."""
    exp_id: str
    repeat: int = 0
    """Number of the repeat of one agent on one environment, from 0."""
    attempt: int = 0
    """How often the operator restarted this run from scratch."""
    run: str = ""
    """The coordinator's name of the run."""
    agent: Agent
    sandbox_tier: Tier
    jail: str
    """How the agent was confined: `bwrap`, `bwrap, open network` or `none`."""
    hidden_isolation: HiddenIsolation = "unknown"
    """Whether hidden episodes and agents could share a kernel: never (`exclusive`), possibly (`shared`), or the
    operator vouched for the agent's place (`waived`). `unknown`: not recorded."""
    experiment_dimensions: ExperimentDimensions
    timing: Timing
    outcome: Outcome
    rejected_submits: tuple[RejectedSubmit, ...] = ()
    artifacts: Artifacts = Artifacts()
    replays: tuple[Replay, ...] = ()
    versions: Versions
    committed: Committed | None = None
    """The coordinator's commitment before the agent started; None in a directory of the published software."""
    start: Start | None = None
    """The submit of an earlier run with whose workspace this one began."""
    replay_of: str = ""
    """The coordinator's name of the run that `evopolicy replay` played again."""
    trees: dict[str, str] = {}
    """Submit index (decimal text) to the SHA-256 of `trees/submit_NNN.json`."""

    @property
    def line(self) -> Line:
        """The weakest conditions of this run and of those that it starts from."""
        use = self.agent.model_use
        metering = metering_of(None if use is None else use.metering, self.agent.model_string)
        own = Line(jail=self.jail, sandbox_tier=self.sandbox_tier, metering=metering)
        return own if self.start is None else own.weakest(self.start.line)

    def summary(self, folder: str) -> RunSummary:
        outcome = self.outcome
        return RunSummary(
            run=folder,
            env=self.env,
            entry=self.agent.entry,
            model=self.model,
            exp_id=self.exp_id,
            repeat=self.repeat,
            status=outcome.status,
            score=outcome.score,
            random_score=outcome.random_score,
            best_submit=outcome.best_submit_index,
            budget=self.experiment_dimensions.episode_budget,
            budget_used=outcome.budget_used,
            closed_reason=outcome.closed_reason,
            wall_s=self.timing.wall_time_seconds,
            start="" if self.start is None else self.start.text,
        )


class _Header(msgspec.Struct, frozen=True, kw_only=True):
    """The fields that identify the writer and version of a `run.json`."""

    schema_version: int | str
    record_version: int | None = None


_headers = msgspec.json.Decoder(_Header)
_runs = msgspec.json.Decoder(RunRecord)


def encode_run_record(record: RunRecord) -> bytes:
    """The bytes of `run.json`: two-space indent, fields in declared order, one newline at the end."""
    return msgspec.json.format(msgspec.json.encode(record), indent=2) + b"\n"


def decode_run_record(data: bytes) -> RunRecord:
    """The record in `data`. Raises ProtocolError when this version cannot read it, such as the published software's."""
    with raised_as(ProtocolError, "not a run record", *DECODE_ERRORS, AttributeError, TypeError, ValueError):
        header = _headers.decode(data)
        if header.schema_version == PUBLISHED_SCHEMA and header.record_version == RECORD_VERSION:
            return check_plausible(_runs.decode(data))
    if header.schema_version == PUBLISHED_SCHEMA and header.record_version is None:
        raise ProtocolError(
            "run.json was written by the published software, not by evopolicy: only `evopolicy report` reads it"
        )
    raise ProtocolError(
        f"run.json has schema_version {header.schema_version} and record_version {header.record_version}; this version"
        f" reads {PUBLISHED_SCHEMA} and {RECORD_VERSION}: use the software that wrote it"
    )


def sha256_text(digest: str) -> str:
    """A hash in the form of `versions`, from its hex digits; empty for an unknown one."""
    return f"sha256:{digest}" if digest else ""
