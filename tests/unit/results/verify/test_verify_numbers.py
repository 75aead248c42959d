"""Edited numbers of a run directory: each is found without playing, by the other numbers or by the coordinator's
result.

Attacks, each with its defence:
- a run directory with edited scores, means, selection, budget, feedback or metadata, swapped policies, or
  submits and episodes left out: `evopolicy verify` names each: numbers must follow from each other and be
  those that the coordinator has. Without the coordinator that played the run, edits that contradict nothing
  in the directory are found only where a train episode shows them; the output says so. Re-scores are checked
  against the run, and the output names those whose returns were not played again.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from edits import edited, put
from invented.policies import Version, policy
from invented.run_dirs import amend, write_run
from rigs.finished_run import finished, played_submit

from evopolicy_common.messages.operator import RunResult
from evopolicy_common.records.code_metrics import TREND
from evopolicy_common.records.policies.checkpoints import bundle_of
from evopolicy_common.records.rescores import Rescored, RescoreRecord, encode_rescore, rescore_path
from evopolicy_results.verify.numbers import differences
from evopolicy_results.verify.source import read_run

VERSIONS = [
    Version(policy(gain=1.0), (-200.0, -100.0), -180.0),
    Version({"policy.py": "import nothing\n"}, (0.0,), None, "import_error"),
    Version(policy(gain=2.0), (-90.0, -95.0), -95.0, failed=(0,)),
]
HELDOUT = [-90.0 - number for number in range(32)]
FIRST, LAST = (f"workspace/feedback/submit_{index}/summary.json" for index in ("000", "002"))
META = "checkpoints/submit_002/_meta.json"
CODE = "checkpoints/submit_002/policy.py"


class Copy:
    """A copy of the run, to be edited."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def edit(self, name: str, change: Callable[[Any], object]) -> None:
        with edited(self.root / name) as document:
            change(document)

    def put(self, name: str, *path: str | int, value: Any) -> None:
        self.edit(name, put(*path, value=value))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = write_run(tmp_path_factory.mktemp("whole"), VERSIONS, heldout=HELDOUT)
    counts = {"policy_failures": {}, "infrastructure_retries": 0, "nondeterministic_results": 0}
    code = dict.fromkeys(map(str, range(len(VERSIONS))))
    trend = {"submits": [*map(int, code)], **{name: [None] * len(code) for name in TREND}}
    told = {"code_metrics_best": None, "code_metrics_by_submit": code, "code_metrics_trend": trend}
    random = {"mean_return": -500.0, "std_return": 0.0, "returns": [-500.0] * 32}
    amend(run, {"outcome": {"auxiliary": told | counts, "random_reference": random}})
    return run


@pytest.fixture(scope="module")
def result(whole: Path) -> RunResult:
    """The coordinator's, of the untouched run."""
    run = read_run(whole)
    outcome = run.record.outcome
    submits = []
    for submit in run.submits:
        assert submit.summary.env_instances is not None
        told = ("status", "env_instances", "remaining_budget", "mean_return")
        summary = {name: getattr(submit.summary, name) for name in told}
        val_mean = (outcome.val_scores or {}).get(str(submit.index))
        bundle = bundle_of(submit.checkpoint).digest
        submits.append(played_submit(submit_index=submit.index, bundle=bundle, val_mean=val_mean, **summary))
    same = ("status", "closed_reason", "best_submit_index", "final_score", "heldout_returns", "budget_used")
    fields: dict[str, Any] = {name: getattr(outcome, name) for name in same}
    fields |= {"random_heldout_returns": (-500.0,) * 32, "validation_ineligible": (), "policy_failures": {}}
    return finished(**fields, submits=tuple(submits)).result


Edit = Callable[[Copy], object]


def _score(run: Copy, returns: list[float]) -> None:
    """Held-out returns, with all that follows from them."""

    def change(record: Any) -> None:
        mean = math.fsum(returns) / len(returns)
        std = math.sqrt(math.fsum((each - mean) ** 2 for each in returns) / len(returns))
        record["outcome"] |= {"heldout_returns": returns, "final_score": mean}
        record["outcome"] |= {"heldout_mean_return": mean, "heldout_std_return": std}

    run.edit("run.json", change)


def _drop_last_submit(run: Copy) -> None:
    for folder in (LAST, META):
        shutil.rmtree((run.root / folder).parent)

    def change(record: Any) -> None:
        del record["outcome"]["val_scores"]["2"]
        record["outcome"] |= {"best_submit_index": 0, "budget_used": 3}

    run.edit("run.json", change)


def _swap_policy(run: Copy, *, named: bool) -> None:
    (run.root / CODE).chmod(0o644)
    (run.root / CODE).write_text("class Policy: pass\n")
    if named:
        run.put(META, "bundle", value=bundle_of((run.root / META).parent).digest)


def _swap_checkpoints(run: Copy) -> None:
    first, last = (run.root / "checkpoints" / f"submit_{index}" for index in ("000", "002"))
    first.rename(run.root / "other")
    last.rename(first)
    (run.root / "other").rename(last)


def _outcome(*path: str | int, value: Any) -> Edit:
    return lambda run: run.put("run.json", "outcome", *path, value=value)


def _summary(name: str, value: Any) -> Edit:
    return lambda run: run.put(LAST, name, value=value)


def _meta(name: str, value: Any) -> Edit:
    return lambda run: run.put(META, name, value=value)


ALONE: dict[str, tuple[Edit, str]] = {
    "a raised score": (_outcome("final_score", value=-1.0), "final_score is -1.0"),
    "a raised mean": (_outcome("heldout_mean_return", value=-1.0), "heldout_mean_return is -1.0"),
    "a smaller spread": (_outcome("heldout_std_return", value=0.5), "heldout_std_return is 0.5"),
    "a raised held-out return": (_outcome("heldout_returns", 0, value=-1.0), "final_score is"),
    "held-out episodes left out": (lambda run: _score(run, HELDOUT[:9]), "number of heldout_returns is 9"),
    "another selection": (_outcome("best_submit_index", value=0), "best_submit_index is 0"),
    "no selection": (_outcome("best_submit_index", value=None), "best_submit_index is None"),
    "a raised validation score": (_outcome("val_scores", "0", value=-1.0), "val_mean is -180.0"),
    "a validation score left out": (lambda run: run.edit("run.json", lambda record: record["outcome"]["val_scores"].pop("0")), "submits of val_scores"),
    "a checkpoint called quarantined": (_outcome("quarantined_submits", value=[2]), "best_submit_index is 2"),
    "a completed run called failed": (_outcome("status", value="no_ok_submit"), "heldout_returns is"),
    "a smaller budget used": (_outcome("budget_used", value=2), "budget_used is 2"),
    "another budget": (lambda run: run.put("run.json", "experiment_dimensions", "episode_budget", value=500), "remaining_budget is 126"),
    "a weaker random reference": (_outcome("random_reference", "returns", value=[-9.0] * 32), "mean of random actions"),
    "a raised train mean": (_summary("mean_return", -1.0), "mean_return is -1.0"),
    "another train spread": (_summary("std_return", 0.5), "std_return is 0.5"),
    "another least return": (_summary("min_return", -90.0), "min_return is -90.0"),
    "another greatest return": (_summary("max_return", -1.0), "max_return is -1.0"),
    "a raised train return": (_summary("returns", [-1.0, -95.0]), "mean_return is -92.5"),
    "returns left out": (_summary("returns", None), "number of returns is 0"),
    "fewer returns than episodes": (_summary("returns", [-90.0]), "number of returns is 1"),
    "another length": (_summary("episode_lengths", [1, 100]), "mean_episode_length is 100.0"),
    "another mean length": (_summary("mean_episode_length", 1.0), "mean_episode_length is 1.0"),
    "fewer episodes charged": (_summary("n_episodes", 1), "n_episodes is 1"),
    "more budget left": (_summary("remaining_budget", 128), "remaining_budget is 128"),
    "an ok submit called failed": (_summary("status", "init_error"), "validation_status is 'ok'"),
    "cases left out": (_summary("env_instances", None), "env_instances is None"),
    "a failure beyond the episodes": (_summary("errors", [0, 7]), "errors is (0, 7)"),
    "another environment": (_summary("env", "gym/pendulum"), "env is 'gym/pendulum'"),
    "another place": (_summary("submit_index", 0), "submit_index is 0"),
    "a checkpoint's train mean": (_meta("mean_return", -1.0), "mean_return is -1.0"),
    "a checkpoint's validation mean": (_meta("val_mean", -1.0), "val_mean is -1.0"),
    "a checkpoint's budget": (_meta("remaining_budget_before", 1), "remaining_budget_before is 1"),
    "a checkpoint's episodes": (_meta("n_episodes_requested", 1), "n_episodes_requested is 1"),
    "a swapped policy": (lambda run: _swap_policy(run, named=False), "does not hold the policy that _meta.json names"),
    "swapped checkpoints": (_swap_checkpoints, "submit_index is 2"),
    "an episode of another run": (lambda run: (run.root / LAST).parent.joinpath("episodes", "ep_009").mkdir(parents=True), "ep_009 is none of its episodes"),
    "a submit dropped": (lambda run: [shutil.rmtree((run.root / name).parent) for name in (FIRST, "checkpoints/submit_000/x")], "files of a submit are missing"),
}  # fmt: skip
"""Edits that the directory itself contradicts, with a part of the difference."""
CONSISTENT: dict[str, tuple[Edit, str]] = {
    "raised held-out returns": (lambda run: _score(run, [-1.0] * 32), "final_score is -1.0; the coordinator has"),
    "the last submit dropped": (_drop_last_submit, "submits is [0, 1]; the coordinator has [0, 1, 2]"),
    "a swapped policy with its digest": (lambda run: _swap_policy(run, named=True), "does not hold the policy that was submitted"),
    "a swapped policy without metadata": (lambda run: [_swap_policy(run, named=False), (run.root / META).unlink()], "does not hold the policy that was submitted"),
    "other cases": (_summary("env_instances", [5, 6]), "env_instances is (5, 6); the coordinator has (0, 1)"),
    "no random reference": (_outcome("random_reference", value=None), "random_reference is None; the coordinator has {"),
    "successes": (_outcome("heldout_successes", value=[True] * 32), "heldout_successes is"),
    "no infrastructure retries": (lambda run: run.edit("run.json", lambda record: record["outcome"].update(auxiliary={"infrastructure_retries": 7})), "auxiliary.infrastructure_retries is 7"),
}  # fmt: skip
"""Edits that only the coordinator's result contradicts."""


def _texts(run: Path, result: RunResult | None) -> list[str]:
    return [f"{name}: {text}" for name, text in differences(read_run(run), result)]


def test_an_untouched_run_has_no_differences(whole: Path, result: RunResult) -> None:
    assert _texts(whole, None) == []
    assert _texts(whole, result) == []


@pytest.mark.parametrize("kind", ALONE)
def test_an_edit_is_found_by_the_other_numbers(whole: Path, tmp_path: Path, kind: str) -> None:
    edit, text = ALONE[kind]
    edit(Copy(Path(shutil.copytree(whole, tmp_path / "run"))))
    texts = _texts(tmp_path / "run", None)
    assert any(text in each for each in texts), texts


@pytest.mark.parametrize("kind", CONSISTENT)
def test_a_consistent_edit_is_found_by_the_coordinators_result(
    whole: Path, tmp_path: Path, result: RunResult, kind: str
) -> None:
    edit, text = CONSISTENT[kind]
    edit(Copy(Path(shutil.copytree(whole, tmp_path / "run"))))
    assert _texts(tmp_path / "run", None) == []
    texts = _texts(tmp_path / "run", result)
    assert any(text in each for each in texts), texts


RESCORE = "rescore/more.json"


def rescored(run: Copy) -> None:
    record = RescoreRecord(
        name="more", run=read_run(run.root).record.run, env="gym/acrobot", selected=2, n_cases=2, cases_hash="sha256:0",
        cases_from="secret", cases_secret=True, random_returns=(-500.0, -500.0),
        checkpoints=(Rescored(submit_index=2, returns=(-90.0, -91.0), lengths=(90, 91), failures={"1": "act_error"}),),
    )  # fmt: skip
    path = rescore_path(run.root, "more")
    path.parent.mkdir()
    path.write_bytes(encode_rescore(record))


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        (("run",), "r-another", "run is"),
        (("env",), "gym/pendulum", "env is"),
        (("selected",), 0, "selected is"),
        (("name",), "less", "name is"),
        (("checkpoints", 0, "submit_index"), 1, "submits of checkpoints"),
        (("checkpoints", 0, "lengths"), [90], "number of lengths"),
        (("checkpoints", 0, "successes"), [True], "number of successes"),
        (("checkpoints", 0, "failures"), {"2": "act_error"}, "failures of submit 2"),
        (("checkpoints", 0, "returns"), [1.0], "does not have 2 returns"),
        (("checkpoints", 0, "returns"), [1e300, 1.0], "not plausible"),
    ],
)
def test_an_edited_rescore_is_found_where_it_contradicts_the_run(
    whole: Path, tmp_path: Path, path: tuple[str | int, ...], value: Any, named: str
) -> None:
    run = Copy(shutil.copytree(whole, tmp_path / "run"))
    rescored(run)
    assert list(differences(read_run(run.root), None)) == []
    run.put(RESCORE, *path, value=value)
    texts = list(differences(read_run(run.root), None))
    assert any(file == RESCORE and named in text for file, text in texts), texts


def test_a_rescore_that_is_a_link_is_a_difference(whole: Path, tmp_path: Path) -> None:
    run = Copy(shutil.copytree(whole, tmp_path / "run"))
    rescored(run)
    (run.root / RESCORE).rename(tmp_path / "elsewhere")
    (run.root / RESCORE).symlink_to(tmp_path / "elsewhere")
    ((file, _),) = differences(read_run(run.root), None)
    assert file == RESCORE
