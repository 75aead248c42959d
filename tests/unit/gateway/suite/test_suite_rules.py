"""Suites: their files, what becomes of each run at a start, what is shown, the index on disk."""

from __future__ import annotations

import random
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from stages.sweep_stage import entry_of

from evopolicy_common import catalogue
from evopolicy_common.errors import ConfigError
from evopolicy_common.records.suite_folder import Index
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.suite import suite_index
from evopolicy_gateway.suite.decisions import (
    Decision,
    Facts,
    check_changes,
    decide,
    feedback_bytes,
    lines,
    side_by_side,
)
from evopolicy_gateway.suite.suite_file import check_agents_start, expand, read_suite
from evopolicy_gateway.suite.suite_index import used

FILE = """
name = "s"
environments = ["toy/line", "toy/maze"]
[defaults]
budget = 8
repeats = 2
[[agents]]
name = "evolve"
agent = "evolve"
[[agents]]
name = "GPT"
[agents.config]
harness = "codex"
model = "gpt-5.5"
[agents.run]
budget = 16
[[overrides]]
environments = ["*/maze"]
agents = ["GPT"]
repeats = 1
heldout = 4
"""


MORE = ("limits", "notes", "n_heldout")
JAIL = '[agents.jail]\nhosts = ["h"]\n'


def suite_in(tmp_path: Path, text: str = FILE) -> list[Plan]:
    path = tmp_path / "s.toml"
    path.write_text(text)
    return expand(read_suite(str(path)), tmp_path / "runs", tmp_path)


def test_runs_are_agents_times_environments_times_repeats_with_overrides(tmp_path: Path) -> None:
    runs = suite_in(tmp_path)
    assert [run.name for run in runs] == [
        *("evolve/toy/line/0", "GPT/toy/line/0", "evolve/toy/maze/0", "GPT/toy/maze/0"),
        *("evolve/toy/line/1", "GPT/toy/line/1", "evolve/toy/maze/1"),
    ]
    by_name = {run.name: run for run in runs}
    assert by_name["evolve/toy/line/0"].settings.budget == 8
    assert by_name["GPT/toy/line/0"].settings.budget == 16
    assert by_name["GPT/toy/line/0"].settings.model == "gpt-5.5"
    assert by_name["GPT/toy/line/0"].provider == "openai"
    assert by_name["GPT/toy/maze/0"].settings.n_heldout == 4
    assert by_name["GPT/toy/line/1"].settings.exp_id == "s-1"
    assert len({run.digest for run in runs}) == len(runs)


def test_a_missing_cli_is_refused_before_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = suite_in(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    check_agents_start([run for run in runs if run.entry == "evolve"])
    with pytest.raises(
        ConfigError, match="'GPT': there is no program 'codex' on the PATH; install it with: npm"
    ):
        check_agents_start(runs)


def test_operational_settings_do_not_make_another_run(tmp_path: Path) -> None:
    before = {run.name: run.digest for run in suite_in(tmp_path)}
    retried = {
        run.name: run.digest
        for run in suite_in(tmp_path, FILE.replace('model = "gpt-5.5"', 'model = "gpt-5.5"\nretries = 9'))
    }
    assert retried == before
    changed = {run.name: run.digest for run in suite_in(tmp_path, FILE.replace("budget = 16", "budget = 32"))}
    assert [name for name in before if changed[name] != before[name]] == [
        *("GPT/toy/line/0", "GPT/toy/maze/0", "GPT/toy/line/1"),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name = 's'", "environments"),
        ("repeats = 2\n" + FILE, r"`repeats`; `repeats` belongs in \[defaults\]"),
        (FILE.replace("budget = 8", "budgte = 8"), r"line \d+: .*`budgte` .*; did you mean budget\?"),
        (
            FILE.replace("budget = 8", 'video = "some"'),
            r"line \d+: .*'some'.*; use one of 'off', 'first', 'all'",
        ),
        (FILE.replace("budget = 8", "budget = 0"), "budget"),
        (
            FILE.replace("budget = 8", "limits = { act_wall = 1 }"),
            "limits.act_wall=1: unknown limit",
        ),
        (
            FILE.replace("budget = 8", "limits = { act_wall_s = 0 }"),
            "limits.act_wall_s=0: a limit must be a finite",
        ),
        (FILE.replace("budget = 8", "limits = { act_wall_s = 1e30 }"), "act_wall_s can be .* at most"),
        (FILE.replace('name = "GPT"', 'name = "evolve"'), "several agents are named evolve"),
        (FILE.replace('agent = "evolve"', 'agent = "nobody"'), "'evolve': --agent 'nobody'"),
        (FILE.replace('name = "s"', 'name = "s/t"'), "letters, digits"),
        (FILE.replace('"toy/line", ', '"gym/no-such", '), "gym/no-such"),
    ],
)
def test_a_wrong_file_is_refused_with_the_place(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        suite_in(tmp_path, text)


SHIPPED = ["smoke.toml", "core16.toml", "core16-paper.toml", "core16-published.toml"]


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_suites_are_whole(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ANTHROPIC_AUTH_TOKEN", "set")
    suite = read_suite(name)
    runs = expand(suite, tmp_path, tmp_path)
    core16 = catalogue.resolve(["core16"])
    assert len(runs) == len(suite.agents) * 16
    assert {run.settings.env for run in runs} == set(core16)
    paper = name in SHIPPED[2:]
    if paper:
        assert {run.settings.model for run in runs} == {
            *("gpt-5.5", "claude-opus-4-7-thinking-max", "MiniMax-M3", "deepseek-v4-pro"),
        }
    if name != "smoke.toml":
        (numbers,) = {
            (run.settings.budget, run.settings.n_validation, run.settings.n_heldout) for run in runs
        }
        assert numbers == (128, 16, 32)
        scopes = {run.settings.policy_scope for run in runs}
        assert scopes == {"submit" if paper else "episode"}
        assert {run.settings.observations for run in runs} == {"lists" if paper else "arrays"}
    profiles = {(run.settings.profile, run.settings.finish) for run in runs}
    assert profiles == {("published", "budget") if "published" in name else ("own", "early")}


def test_a_file_that_contradicts_its_profile_is_refused(tmp_path: Path) -> None:
    text = FILE.replace("budget = 8", 'budget = 8\nprofile = "published"\nobservations = "arrays"')
    with pytest.raises(ConfigError, match="observations = lists, but arrays was given"):
        suite_in(tmp_path, text)


def test_the_facts_about_a_run_decide_its_start(tmp_path: Path) -> None:
    run = suite_in(tmp_path)[0]
    running = entry_of(run, state="running")
    cases = [
        (Facts(), "new", 1),
        (Facts(status="completed", entry=entry_of(run, state="completed")), "keep", 1),
        (Facts(status="no_ok_submit"), "keep", 1),
        (Facts(entry=entry_of(run, state="completed", host="other")), "keep", 1),
        (
            Facts(entry=entry_of(run, state="completed", host="other"), opened=True, phase="finished"),
            "keep",
            1,
        ),
        (Facts(status="error", entry=entry_of(run, state="error", attempt=2)), "restart", 3),
        (Facts(opened=True, phase="open", has_session=True, entry=running), "resume", 1),
        (Facts(opened=True, phase="open", has_session=False, entry=running), "restart", 2),
        (Facts(opened=True, phase="heldout", has_session=False, entry=running), "finish", 1),
        # The cluster may have lost it, and opens it again; an agent that has ended is never started again.
        (Facts(opened=True, phase=None, has_session=True, entry=running), "resume", 1),
        (Facts(opened=True, phase=None, entry=running), "restart", 2),
        (Facts(opened=True, phase=None, closing=True, entry=running), "finish", 1),
        (Facts(opened=True, phase="open", has_session=True, closing=True, entry=running), "finish", 1),
        (Facts(entry=running), "restart", 2),
        (Facts(entry=running, intended=True), "resume", 1),
    ]
    for facts, kind, attempt in cases:
        decision = decide(run, facts)
        assert (decision.kind, decision.attempt) == (kind, attempt), facts


def test_a_changed_file_is_the_operators_decision(tmp_path: Path) -> None:
    run = suite_in(tmp_path)[0]
    facts = Facts(status="completed", entry=entry_of(run, state="completed", digest="another"))
    refused = [decide(run, facts, "refuse")]
    with pytest.raises(ConfigError, match="evolve/toy/line/0 was played: give --changed keep"):
        check_changes(refused, "refuse")
    assert decide(run, facts, "keep").kind == "keep"
    again = decide(run, facts, "rerun")
    assert (again.kind, again.attempt) == ("restart", 2)
    check_changes([again], "rerun")
    shown = lines([again], ["gone/toy/line/0"])
    assert shown[0] == "1 runs: 1 restarted as a new attempt"
    assert "the file has other settings" in shown[1]
    assert "no longer in the file" in shown[2]


def test_only_what_is_played_takes_room_for_feedback(tmp_path: Path) -> None:
    kept, new = suite_in(tmp_path)[:2]  # of 8 and of 16 train episodes
    line = catalogue.entry("toy/line")
    episode = line.max_episode_steps * line.step_bytes
    assert feedback_bytes([Decision(run=kept, kind="keep", attempt=1)]) == 0
    both = [Decision(run=kept, kind="restart", attempt=2), Decision(run=new, kind="new", attempt=1)]
    assert feedback_bytes(both) == 24 * episode
    usual = msgspec.structs.replace(new, settings=msgspec.structs.replace(new.settings, budget=None))
    assert feedback_bytes([Decision(run=usual, kind="resume", attempt=1)]) == 128 * episode


def test_changed_settings_of_the_file_are_named(tmp_path: Path) -> None:
    before = {run.name: run for run in suite_in(tmp_path)}
    text = FILE.replace("budget = 16", "budget = 32\nvalidation = 4\nlimits = { act_wall_s = 2.0 }")
    text = text.replace('"gpt-5.5"', '"gpt-6"\neffort = "high"').replace(
        "[agents.run]", JAIL + "[agents.run]"
    )
    for run in suite_in(tmp_path, text):
        was = before[run.name]
        known = entry_of(was, state="completed", settings=msgspec.to_builtins(was.defining))
        decision = decide(run, Facts(status="completed", entry=known), "rerun")
        if run.entry == "evolve":
            assert decision.kind == "keep"
            continue
        changes = decision.why.partition("now: ")[2]
        assert 'config.model is "gpt-6", was "gpt-5.5"' in changes
        assert 'config.effort is "high", was not set' in changes
        assert changes.endswith("and 4 more")
    only_budget = suite_in(tmp_path, FILE.replace("budget = 16", "budget = 32"))[1]
    known = entry_of(
        was := before[only_budget.name], settings=msgspec.to_builtins(was.defining), state="completed"
    )
    why = decide(only_budget, Facts(status="completed", entry=known), "keep").why
    assert why == "the file has other settings for it now: budget is 32, was 16"


def test_a_setting_that_a_later_version_adds_makes_no_other_run(tmp_path: Path) -> None:
    for run in suite_in(tmp_path, FILE.replace("budget = 16", "limits = { act_wall_s = 2.0 }")):
        defining = run.defining
        assert set(defining["settings"]) <= {"env", "entry", "model", "exp_id", "repeat", "budget", *MORE}
        if run.entry == "GPT":
            assert defining["config"] == {"harness": "codex", "model": "gpt-5.5"}
            assert defining["settings"]["limits"] == {"act_wall_s": 2.0}


def test_a_jails_permissions_make_another_run_but_program_paths_do_not(tmp_path: Path) -> None:
    before = suite_in(tmp_path)[1].digest
    shown = FILE.replace("[agents.run]", '[agents.jail]\nread = ["/opt"]\n[agents.run]')
    assert suite_in(tmp_path, shown)[1].digest == before
    assert suite_in(tmp_path, FILE.replace("[agents.run]", JAIL + "[agents.run]"))[1].digest != before


def test_the_index_is_another_sweeps_or_is_read_back(tmp_path: Path) -> None:
    run = suite_in(tmp_path)[0]
    index = Index(suite="s", runs={run.name: entry_of(run, state="completed", score=1.5)})
    suite_index.save(tmp_path, index)
    assert suite_index.load(tmp_path, "s") == index
    with pytest.raises(ConfigError, match="is of suite 's'"):
        suite_index.load(tmp_path, "other")
    (tmp_path / "suite.json").write_text("{")
    with pytest.raises(ConfigError, match="cannot be read"):
        suite_index.load(tmp_path, "s")


def test_a_sweeps_use_adds_up_over_its_runs(tmp_path: Path) -> None:
    one, two, three = suite_in(tmp_path)[:3]
    tokens = {"input_noncached": 1, "cache_read": 2, "cache_creation": 3, "output": 4, "reasoning": 4}
    runs = {
        one.name: entry_of(one, tokens=tokens),
        two.name: entry_of(two, tokens={**tokens, "cost": 0.5, "requests": 7}),
        three.name: entry_of(three),
    }
    assert used(Index(suite="s", runs=runs)) == (20, 0.5, 7)


PLACES = st.tuples(st.sampled_from("abcd"), st.sampled_from(["shared", "per_run"]))
"""A run's environment, and whether it shares its hidden cases."""


def waiting(places: list[tuple[str, str]]) -> list[Decision]:
    run = expand(read_suite("smoke"), Path(), Path())[0]
    return [
        Decision(
            run=msgspec.structs.replace(
                run,
                name=f"{number}",
                settings=msgspec.structs.replace(run.settings, env=env, hidden_cases=cases),  # type: ignore[arg-type]
            ),
            kind="new",
            attempt=1,
        )
        for number, (env, cases) in enumerate(places)
    ]


def related(one: Plan, other: Plan) -> bool:
    shared = {one.settings.hidden_cases, other.settings.hidden_cases} == {"shared"}
    return one.name == other.name or (shared and one.settings.env == other.settings.env)


@given(st.lists(PLACES, max_size=12), st.lists(PLACES, max_size=6))
def test_runs_with_fewest_related_ones_come_first(
    places: list[tuple[str, str]], busy: list[tuple[str, str]]
) -> None:
    under_way = [
        msgspec.structs.replace(one.run, name=f"busy {number}") for number, one in enumerate(waiting(busy))
    ]
    before = waiting(places)
    after = side_by_side(before, under_way)
    shared = [sum(related(one.run, other) for other in under_way) for one in after]
    assert sorted(one.run.name for one in after) == sorted(one.run.name for one in before)
    assert shared == sorted(shared)
    for number in set(shared):
        kept = [int(one.run.name) for one, n in zip(after, shared, strict=True) if n == number]
        assert kept == sorted(kept)


@given(st.integers(1, 5), st.integers(1, 5), st.integers(1, 4), st.randoms(use_true_random=False))
def test_related_runs_meet_only_where_nothing_else_is_left(
    agents: int, environments: int, parallel: int, luck: random.Random
) -> None:
    left = waiting([(f"env-{env}", "shared") for env in range(environments) for _ in range(agents)])
    under_way: list[Plan] = []
    while left:
        while left and len(under_way) < parallel:
            decision = side_by_side(left, under_way)[0]
            met = any(related(decision.run, other) for other in under_way)
            free = any(not any(related(one.run, other) for other in under_way) for one in left)
            assert not (met and free)
            left.remove(decision)
            under_way.append(decision.run)
        under_way.remove(luck.choice(under_way))
