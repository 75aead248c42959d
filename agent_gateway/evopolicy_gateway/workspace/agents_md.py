"""The staged `AGENTS.md`: a run's rules, with literal URLs and commands that run unchanged.

`agents.md` is the standard text, and `agents.toml` has its parts that differ from run to run.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from string import Template

import msgspec

from evopolicy_common.messages.gateway import RunOpened
from evopolicy_common.records.words import CANARY
from evopolicy_gateway.run_folder.layout import episode_name, submit_id
from evopolicy_gateway.submits.episode_files import episode_share, shows_texts


class Urls(msgspec.Struct, frozen=True, kw_only=True):
    info: str
    task: str
    submit: str
    bearer: bool = False
    """Whether every request needs the bearer token in `EVOPOLICYGYM_TOKEN`."""

    @property
    def api(self) -> str:
        """Common base of the other three."""
        return self.info.rpartition("/")[0]

    def environment(self) -> dict[str, str]:
        urls = {"API": self.api, "INFO_URL": self.info, "TASK_URL": self.task, "SUBMIT_URL": self.submit}
        return {f"EVOPOLICYGYM_{name}": url for name, url in urls.items()}


def base_url(host: str, port: int) -> str:
    """The URL of an address, without a trailing `/`."""
    return f"http://{f'[{host}]' if ':' in host else host}:{port}"


def urls_below(base: str, token: str, *, bearer: bool = False) -> Urls:
    """The URLs of a service below `base`, such as `http://127.0.0.1:4711`."""
    root = f"{base}/{token}"
    return Urls(info=f"{root}/info", task=f"{root}/task", submit=f"{root}/submit", bearer=bearer)


LAST_WORDS_S = 10.0
"""Seconds that an agent has to end by itself once its budget is spent."""

NO_URLS = Urls(info="INFO_URL", task="TASK_URL", submit="SUBMIT_URL")
"""Placeholders for the URLs in the hash of the rules in `run.json`."""

_TEXT = Template(Path(__file__).with_name("agents.md").read_text(encoding="utf-8"))
_PARTS = tomllib.loads(Path(__file__).with_name("agents.toml").read_text(encoding="utf-8"))
"""Parts of the text that differ from run to run."""

STANDARD = _TEXT.template
"""The standard text with its placeholders, which an operator's own text may use too."""
PLACEHOLDERS = ("standard", *_TEXT.get_identifiers())
"""In an operator's own text; `$standard` is the whole standard text."""


def agents_md(run: RunOpened, urls: Urls, text: str = "", *, started: bool = False) -> str:
    """The text for one run. `text`: the operator's own, or empty. `started`: from an earlier submit."""
    n_example = max(run.min_episodes_per_submit, min(2, run.max_episodes_per_submit, run.episode_budget))
    example = [index % run.n_env_instances for index in range(n_example)]
    most = min(run.max_episodes_per_submit, run.episode_budget)
    usual = run.n_env_instances > 7 and run.min_episodes_per_submit <= 5 <= most
    known = _PARTS["with_bearer" if urls.bearer else "without_bearer"] | {
        "env": run.env.env,
        "budget": str(run.episode_budget),
        "least": str(run.min_episodes_per_submit),
        "most": str(most),
        "last_id": str(run.n_env_instances - 1),
        "example": str(example),
        "ranges": "0-3,7" if usual else _ranges(n_example, run.n_env_instances),
        "scope": _PARTS["scope"][run.policy_scope],
        "evidence": _PARTS["evidence"][run.simulation],
        "rule": _PARTS["rule"][run.simulation],
        "finish": _PARTS["finish"][run.finish],
        "observations": _PARTS["observations"][run.observations],
        "fails": _PARTS["fails"][run.failed_episodes],
        "or_failed": ", or the policy failed in an episode" if run.failed_episodes == "end-submit" else "",
        "imports": ", ".join(f"`{name}`" for name in run.allowed_imports) or "no package",
        "threads": str(run.limits.processes),
        "first_submit": submit_id(0, run.episode_budget),
        "first_episode": episode_name(0, run.episode_budget),
        "task_url": urls.task,
        "info_url": urls.info,
        "submit_url": urls.submit,
        "last_words": f"{LAST_WORDS_S:g}",
        "canary": CANARY,
        "history": _PARTS["more"]["history"] if started else "",
        "share": f"{episode_share(run.limits, run.episode_budget):,}",
    }
    known["look"] = "" if run.feedback == "scores" else Template(_PARTS["more"]["look"]).substitute(known)
    known["files"] = Template(_feedback_files(run)).substitute(known)
    standard = _TEXT.substitute(known)
    return Template(text).substitute(known, standard=standard) if text else standard


def _feedback_files(run: RunOpened) -> str:
    texts = shows_texts(run.feedback, run.env.obs_storage)
    shown = {"texts": texts, "error.txt": texts, "failure": not texts}
    rows = [
        file["row"] if run.profile == "own" else file.get("published", file["row"])
        for file in _PARTS["files"]
        if shown.get(file["name"], run.feedback in file.get("levels", ()))
    ]
    if run.feedback in _PARTS["less"] and not (run.feedback == "trajectories" and texts):
        rows += ["", _PARTS["less"][run.feedback]]
    return "\n".join(rows) + "\n"


def _ranges(n_episodes: int, n_ids: int) -> str:
    whole, rest = divmod(n_episodes, n_ids)
    lengths = [n_ids] * whole + [rest] * (rest > 0)
    return ",".join("0" if length == 1 else f"0-{length - 1}" for length in lengths)
