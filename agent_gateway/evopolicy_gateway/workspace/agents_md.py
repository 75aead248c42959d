"""The staged `AGENTS.md`: a run's rules, with literal URLs and commands that run unchanged. Pure."""

from __future__ import annotations

from string import Template

import msgspec

from evopolicy_common.messages.gateway import FeedbackDetail, RunOpened
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


_SCOPE = {
    "episode": "Every episode gets a fresh process and a fresh `Policy`.",
    "submit": "One `Policy` plays all episodes of a submit one after another; `reset` is called before each.",
}
_FAILS = {
    "play-on": "random actions play the rest of that episode.",
    "end-submit": "that episode ends, and the submit has no mean return and cannot\nbe selected.",
}
_ASK = 'SUBMIT_URL + "/" + str(answer["submit_id"])'
_WITHOUT_BEARER = dict.fromkeys(("auth", "os", "headers", "more_headers"), "") | {
    "addresses": "service's addresses are also in `EVOPOLICYGYM_API` (base), `EVOPOLICYGYM_INFO_URL`, `EVOPOLICYGYM_TASK_URL` and `EVOPOLICYGYM_SUBMIT_URL`.",
    "question": _ASK,
}
_WITH_BEARER = {
    "auth": '-H "Authorization: Bearer $EVOPOLICYGYM_TOKEN" ',
    "addresses": "service wants a token with every request, which is in `EVOPOLICYGYM_TOKEN`.",
    "os": "os, ",
    "headers": 'AUTH = {"Authorization": "Bearer " + os.environ["EVOPOLICYGYM_TOKEN"]}\n',
    "more_headers": ", **AUTH",
    "question": f"urllib.request.Request({_ASK}, headers=AUTH)",
}

LAST_WORDS_S = 10.0
"""Seconds that an agent has to end by itself once its budget is spent."""

NO_URLS = Urls(info="INFO_URL", task="TASK_URL", submit="SUBMIT_URL")
"""Placeholders for the URLs in the hash of the rules in `run.json`."""

_TEXT = Template("""\
# Improve a policy

You improve one program, `system/policy.py`, that plays an environment: `$env`. Only a **submit** plays the environment, and
the run has a budget of **$budget episodes**. $evidence

1. Read the task: what is observed, what actions do, how reward is computed.
2. Edit `system/policy.py` (and other files in `system/`).
3. Submit it on train cases. Read the feedback. Repeat while budget remains.

$finish, every submit with status `ok` plays hidden validation cases. The best of them is your
result, and its mean return on further hidden cases is your score: a policy must do well on cases it has not seen.

$rule## Where things are

| path | what |
|---|---|
| `system/` | yours: `policy.py` with a top-level `class Policy`, and whatever it imports or reads |
| `feedback/` | written by the service after each submit; read it, do not change it |
$history| `AGENTS.md` | this file; do not change it |

Anything else you put here is your own scratch space and is never played. Your working directory is this folder. The
$addresses

## Ask

The task, in markdown:

```bash
curl -sS $auth$task_url
```

Budget left, spaces, limits and allowed imports, as JSON:

```bash
curl -sS $auth$info_url
```

## Submit

`env_instances` lists train ids from 0 to $last_id, `$example` or `"$ranges"`; order and repeats are kept. A submit has $least
to $most episodes. **Every episode asked for is charged**, also when the policy crashes. One submit at a time.

```bash
curl -sS ${auth}-X POST -H 'Content-Type: application/json' -d '{"env_instances": $example}' '$submit_url'
```

It answers when all episodes are played. If your tools give up on slow commands, do not wait: `?wait=false` answers at once
with a `submit_id`, a number, which you can ask about until its `status` is no longer `running`. From Python:

```python
import json, ${os}time, urllib.request, uuid

SUBMIT_URL = "$submit_url"
$headers
def submit(env_instances):
    request = urllib.request.Request(
        SUBMIT_URL + "?wait=false",
        data=json.dumps({"env_instances": env_instances}).encode(),
        # The key makes it safe to send the same request again: it is charged once.
        headers={"Content-Type": "application/json", "Idempotency-Key": str(uuid.uuid4())$more_headers},
    )
    answer = json.load(urllib.request.urlopen(request))
    while answer["status"] == "running":
        time.sleep(1)
        answer = json.load(urllib.request.urlopen($question))
    return answer

answer = submit($example)
print(answer["feedback"], answer["status"], answer["summary"]["mean_return"], answer["warning"] or "")
```

| answer | meaning |
|---|---|
| 200, status `ok` | played. `policy_failures` counts the episodes in which your policy failed, and `warning` says how: look at both before the returns |
| 200, `missing_policy`, `denied_import`, `import_error`, `init_error` | `system/` gives no `Policy`: charged, see `errors.txt` |
| 200, `rollout_timeout` | it took too long$or_failed: charged |
| 400, `budget_invalid`, `invalid_env_instance` | the request is wrong: nothing charged, the message says why |
| 200 or 409, `cancelled` | the operator has ended the run: nothing charged, nothing more is taken |
| 409, `run_closed` | the budget is spent: no more submits are taken |
| 409 | another submit is running, or an `Idempotency-Key` was used twice for different requests |

The answer to the submit that spends the budget has `"is_finalized": true`, and so has `/info`. You then have $last_words s to end by
yourself before you are ended.

## The policy

```python
class Policy:
    def __init__(self, obs_space, action_space, env_meta): ...
    def reset(self, episode_index): ...      # before each episode
    def act(self, obs): ...                  # once a step; returns an action
```

$scope Observations arrive as $observations.
If it raises or exceeds a limit, $fails An action that cannot be read counts as zeros (the
lowest choice where there are choices).

It runs in a sandbox. It may import Python's standard library, its own modules in `system/` and $imports, and nothing else; use up to
$threads threads; read its own copy of `system/`, and write there and to `/tmp` until the episode is over. It may not start processes
(`subprocess`, `os.fork`, `multiprocessing`), use the network, or see other files. Limits on time and memory are in `/info`.

## Feedback

The first submit is `$first_submit`, its first episode `$first_episode`:

```bash
cat feedback/$first_submit/summary.json
$look```

| file | what |
|---|---|
| `summary.json` | status, returns, lengths, failed episodes; the same as the answer's `summary` |
| `errors.txt` | why a submit is not `ok`, JSON lines |
$files
Episodes are numbered through the run. While a submit runs, its finished episodes are in `$first_submit.partial/` and so on.

## Not allowed

- Looking for hidden cases, seeds or scores, or for other runs.
- Changing `feedback/` or this file; interfering with the service or with the sandbox.
- Policies that try to tell hidden cases from train cases, or that leave data behind for later.

<!-- $canary -->
""")


_HISTORY = (
    "| `history/` | the feedback of an earlier run, up to the submit whose files you find here; read it, do not change"
    " it |\n"
)
_OBSERVATIONS = {
    "arrays": "numpy arrays, ints, strings, dicts and tuples",
    "lists": "nested lists, numbers, strings and dicts",
}
_EVIDENCE = {
    "forbidden": "What you know of it comes from submitted episodes\nand from nothing else.",
    "allowed": "This run lets you experiment with\nsimulations of your own as well; only submits count.",
}
_FINISH = {
    "early": "When the budget is spent or you stop",
    "budget": "Spend the whole budget: a run that ends with episodes left is an error and has no score. When it is spent",
}
_LOOK = "head -n 2 feedback/$first_submit/episodes/$first_episode/trajectory.jsonl\n"
_STACKED = (
    "| `episodes/ep_*/observations.npy`, `.npz` for dictionaries | observations of more than 4,096 bytes in one array, read"
    " with `numpy.load`; `obs` is null then |"
)
_FILES: dict[str, tuple[tuple[FeedbackDetail, ...], str]] = {
    "trajectory.jsonl": (
        ("trajectories", "pictures"),
        "| `episodes/ep_*/trajectory.jsonl` | a line a step: `t, obs, action, reward, terminated, truncated, info` |",
    ),
    "observations.npz": (
        ("pictures",),
        "| `episodes/ep_*/observations.npz` (runs on older workers: `.npy`) | observations that are pictures, read with"
        " `numpy.load`: the array `observations`, or one for each part of the space; `obs` is null then |",
    ),
    "texts": ((), "| `episodes/ep_*/stdout.txt`, `stderr.txt` | what the policy printed |"),
    "error.txt": ((), "| `episodes/ep_*/error.txt` | step, category and traceback where the policy failed |"),
    "failure": ((), "| `episodes/ep_*/error.txt` | step and category where the policy failed |"),
    "video.mp4": (
        ("pictures",),
        "| `episodes/ep_*/video.mp4` | a frame a step, where this run records videos |",
    ),
    "left_out.txt": (
        ("trajectories", "pictures"),
        "| `episodes/ep_*/left_out.txt` | what is missing because the episode's files would take more than $share bytes:"
        " first the video, then the observations, then the rows |",
    ),
}
"""Rows of the table of feedback files, with the levels of detail that have them; the others depend on `shows_texts`."""
_LESS = {
    "scores": "This run shows scores alone: no trajectories, and nothing that a policy prints.",
    "trajectories": "This run shows no pictures: observations that are stored outside the rows are left out.",
}
_RULE = {
    "forbidden": """\
## The rule of the budget

Rollouts happen through a submit and in no other way. Every experiment with the environment costs episodes, so that agents
can be compared by what they learn from them.

Not allowed, on this machine or elsewhere:

- Running the environment or another simulator of it: Gymnasium, MuJoCo, Box2D, highway-env, MiniGrid or the like.
- Copying or rewriting its dynamics or its reward function, from memory, from sources or from a fit to the feedback, in order
  to produce observations, rewards, lengths, returns or scores.
- Training, searching or tuning a policy in such a simulation. This holds for code in `system/` too.

Allowed:

- Unit tests of your own code, such as a parser, a controller or a planner on inputs that you made up.
- Analysing `feedback/`: statistics, plots, comparing trajectories of submits.
- Replaying recorded observations through a policy to see which actions it takes.
- Control laws, geometry and search over what an observation shows, as long as they do not step the environment's dynamics.

""",
    "allowed": "",
}


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
    known = (_WITH_BEARER if urls.bearer else _WITHOUT_BEARER) | {
        "env": run.env.env,
        "budget": str(run.episode_budget),
        "least": str(run.min_episodes_per_submit),
        "most": str(most),
        "last_id": str(run.n_env_instances - 1),
        "example": str(example),
        "ranges": "0-3,7" if usual else _ranges(n_example, run.n_env_instances),
        "scope": _SCOPE[run.policy_scope],
        "evidence": _EVIDENCE[run.simulation],
        "rule": _RULE[run.simulation],
        "finish": _FINISH[run.finish],
        "observations": _OBSERVATIONS[run.observations],
        "fails": _FAILS[run.failed_episodes],
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
        "history": _HISTORY if started else "",
        "share": f"{episode_share(run.limits, run.episode_budget):,}",
    }
    known["look"] = "" if run.feedback == "scores" else Template(_LOOK).substitute(known)
    known["files"] = Template(_feedback_files(run)).substitute(known)
    standard = _TEXT.substitute(known)
    return Template(text).substitute(known, standard=standard) if text else standard


def _feedback_files(run: RunOpened) -> str:
    texts = shows_texts(run.feedback, run.env.obs_storage)
    shown = {"texts": texts, "error.txt": texts, "failure": not texts}
    known = dict(_FILES)
    if run.profile != "own":
        known["observations.npz"] = (("pictures",), _STACKED)
    rows = [row for name, (levels, row) in known.items() if shown.get(name, run.feedback in levels)]
    if run.feedback in _LESS and not (run.feedback == "trajectories" and texts):
        rows += ["", _LESS[run.feedback]]
    return "\n".join(rows) + "\n"


def _ranges(n_episodes: int, n_ids: int) -> str:
    whole, rest = divmod(n_episodes, n_ids)
    lengths = [n_ids] * whole + [rest] * (rest > 0)
    return ",".join("0" if length == 1 else f"0-{length - 1}" for length in lengths)
