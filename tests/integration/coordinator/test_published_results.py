"""Results that were really played and published: untouched they hold, and each kind of tampering is named.

Most forgers here are strong: they make all digests, the journal's head and the signature anew, with a key of their own.
They cannot make anew a field that follows from another one.

Attacks, each with its defence:
- NaN, huge numbers, text that is not UTF-8, endless nesting, later versions: refused with the file's name.
- changed returns, swapped policies, dropped runs and episodes, edited settings, other splits, reordered
  submits, a cut or edited journal, another signer: the check reports each, even if digests and signature are
  recomputed with another key.
- rewards that the environment does not give, with a new journal that matches them: only `--replay` and
  `--identity` find it.
"""

from __future__ import annotations

import asyncio
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from commands import evopolicy, words
from edits import put
from publications import CONSTANT, Forger, Held, Results, spelt

from evopolicy_common.records import journal
from evopolicy_common.records.policies import bundles
from evopolicy_common.records.policies.bundles import BundleFile
from evopolicy_results.publish import contents, rules
from evopolicy_results.publish import replay as replays
from evopolicy_results.publish.findings import KINDS, Finding

pytestmark = pytest.mark.system


RUN, RESULT, OPENING, EPISODES, SALT = (
    f"runs/0000/{name}"
    for name in (contents.RUN, contents.RESULT, contents.OPENING, contents.EPISODES, contents.SALT)
)


def swap_policy(forger: Forger) -> None:
    bundle = bundles.pack([BundleFile("policy.py", False, b"class Policy: pass")])
    forger.files["runs/0000/checkpoints/001"] = bundle.packed


def swap_policy_and_result(forger: Forger) -> None:
    swap_policy(forger)
    digest = contents.digest(forger.files["runs/0000/checkpoints/001"])
    forger.json(RESULT, put("submits", 1, "bundle", value=digest))


def drop_run(forger: Forger) -> None:
    forger.files = {name: data for name, data in forger.files.items() if not name.startswith("runs/0001/")}


def double_run(forger: Forger) -> None:
    for name, data in list(forger.files.items()):
        if name.startswith("runs/0000/"):
            forger.files[name.replace("runs/0000", "runs/0002")] = data


def entry_edited(lines: list[bytes]) -> list[bytes]:
    return [lines[0].replace(b'"entry":"mine"', b'"entry":"ours"'), *lines[1:]]


START = {"run": "r-1", "submit_index": 0, "tree": "ab" * 32, "parent_scored": False}


def replay_entry(lines: list[bytes]) -> list[bytes]:
    return [lines[0].replace(b'"replay_of":""', b'"replay_of":"r-1"'), *lines[1:]]


def start_from_itself(forger: Forger) -> None:
    run = json.loads(forger.files[OPENING])["run"]
    lines = contents.journal_entries(forger.files[contents.JOURNAL])
    entries = [json.loads(line) for line in lines]
    for each in entries:
        if each["kind"] == "opened" and each["run"] == run:
            each["start"] = {**START, "run": run}
    forger.entries(lambda _: [spelt(contents.JOURNAL, each) for each in entries])


def call_ineligible(forger: Forger) -> None:
    """The submit with the best validation, so that its publisher may select by held-out returns."""
    result = json.loads(forger.files[RESULT])
    best = result["best_submit_index"]
    result["submits"][best]["val_mean"] = None
    forger.put(RESULT, result | {"validation_ineligible": [best], "best_submit_index": 1 - best})


def better_result(forger: Forger) -> None:
    """All that the forger can raise consistently."""
    for name, path in ((RESULT, ("heldout_returns",)), (RUN, ("outcome", "heldout_returns"))):
        document = json.loads(forger.files[name])
        part = document
        for step in path[:-1]:
            part = part[step]
        part[path[-1]] = [0.0, 0.0, 0.0]
        (document if name == RESULT else document["outcome"])["final_score"] = 0.0
        forger.put(name, document)


Edit = Callable[[Forger], None]
SIGNED_ANEW: dict[str, tuple[Edit, str, str]] = {
    "a changed held-out return": (lambda f: f.json(EPISODES, put(4, "episodes", 0, "episode_return", value=99.0)), "scores", "not those of the result"),
    "a changed train return": (lambda f: f.json(EPISODES, put(0, "episodes", 0, "episode_return", value=99.0)), "scores", "have the mean"),
    "a changed validation return": (lambda f: f.json(EPISODES, put(2, "episodes", 1, "episode_return", value=99.0)), "scores", "have the mean"),
    "a dropped episode": (lambda f: f.json(EPISODES, lambda summary: summary[4]["episodes"].pop() and None), "scores", "instead of"),
    "a dropped list of episodes": (lambda f: f.json(EPISODES, lambda summary: summary[:-1]), "scores", "are not there"),
    "a doubled list of episodes": (lambda f: f.json(EPISODES, lambda summary: [*summary, summary[0]]), "scores", "twice"),
    "a swapped checkpoint": (swap_policy, "checkpoints", "another policy"),
    "a swapped checkpoint and its digest": (swap_policy_and_result, "result", "not the result"),
    "an edited setting": (lambda f: f.json(RUN, put("experiment_dimensions", "policy_scope", value="submit")), "record", "policy_scope"),
    "an edited setting in the opening too": (lambda f: f.json(OPENING, put("settings", "policy_scope", value="submit")), "commitment", "not those that were committed to"),
    "an edited budget": (lambda f: f.json(OPENING, put("budget", value=500)), "commitment", "not those that were committed to"),
    "splits that do not match the commitment": (lambda f: f.json(OPENING, put("heldout", 0, "seed", value=7)), "commitment", "not those that were committed to"),
    "a held-out case that is a train case": (lambda f: f.json(OPENING, lambda summary: summary["heldout"].__setitem__(0, summary["train"][0])), "commitment", "not disjoint"),
    "another salt": (lambda f: f.files.__setitem__(SALT, b"00" * 32), "commitment", "not those that were committed to"),
    "a salt of no length": (lambda f: f.files.__setitem__(SALT, b""), "commitment", "0 bytes instead of 32"),
    "another hash of the splits": (lambda f: f.json(RUN, put("versions", "cases_hashes", "heldout", value="sha256:00")), "record", "cases_hashes.heldout"),
    "public cases called secret": (lambda f: f.json(RUN, put("versions", "data_secret", value=False)), "record", "data_secret"),
    "a raised score": (lambda f: f.json(RUN, put("outcome", "final_score", value=1000.0)), "record", "final_score"),
    "a raised score everywhere": (better_result, "result", "not the result"),
    "a smaller spread": (lambda f: f.json(RUN, put("outcome", "heldout_std_return", value=0.001)), "record", "heldout_std_return"),
    "a weaker random reference": (lambda f: f.json(RUN, put("outcome", "random_reference", "mean_return", value=-1e6)), "record", "random_reference.mean_return"),
    "a validation mean edited": (lambda f: f.json(RUN, put("outcome", "val_scores", "0", value=1e6)), "record", "val_scores"),
    "metrics of code that are none": (lambda f: f.json(RUN, put("outcome", "auxiliary", "code_metrics_by_submit", value=None)), "record", "metrics of code in another form"),
    "overrides without end": (lambda f: f.json(RESULT, put("n_overrides", value=2**62)), "record", "fingerprint_overrides"),
    "another selected checkpoint": (lambda f: f.json(RESULT, lambda summary: put("best_submit_index", value=1 - summary["best_submit_index"])(summary)), "selection", "has the best validation mean"),
    "the best submit called ineligible": (call_ineligible, "selection", "which the settings do not allow"),
    "the best submit without a validation": (lambda f: f.json(RESULT, put("submits", 1, "val_mean", value=None)), "selection", "[] are recorded as ineligible"),
    "a scored run called one without an ok submit": (lambda f: f.json(RESULT, lambda summary: summary.update(status="no_ok_submit", best_submit_index=None)), "selection", "has the best validation mean"),
    "reordered submits": (lambda f: f.json(RESULT, lambda summary: summary["submits"].reverse()), "budget", "not in order"),
    "a submit left out": (lambda f: f.json(RESULT, lambda summary: summary["submits"].pop() and None), "budget", "episodes"),
    "a submit of more episodes than granted": (lambda f: f.json(RESULT, lambda summary: summary["submits"][0]["env_instances"].extend([0] * 9)), "budget", "were granted"),
    "a submit on a case that is not one of train": (lambda f: f.json(RESULT, put("submits", 0, "env_instances", 0, value=10**6)), "budget", "not one of train"),
    "a failed run called completed": (lambda f: f.json(RUN, put("outcome", "status", value="no_ok_submit")), "record", "status"),
    "another agent's name": (lambda f: f.json(RUN, put("agent", "entry", value="theirs")), "record", "agent.entry"),
    "another environment": (lambda f: f.json(RUN, put("env", value="gym/acrobot")), "record", "env"),
    "another repeat": (lambda f: f.json(RUN, put("repeat", value=5)), "record", "repeat"),
    "a start that it did not have": (lambda f: f.json(RUN, lambda record: {**record, "start": START}), "record", "start"),
    "a start in the opening too": (lambda f: f.json(OPENING, put("settings", "start", value=START)), "commitment", "not those that were committed to"),
    "a start from itself": (start_from_itself, "journal", "was not opened before it"),
    "a tree that was not recorded": (lambda f: f.json(RUN, put("trees", "0", value="ab" * 32)), "record", "trees"),
    "a replay, by its record": (lambda f: f.json(RUN, put("replay_of", value="r-1")), "record", "replay_of"),
    "a replay, by its opening": (lambda f: f.json(OPENING, put("settings", "replay_of", value="r-1")), "commitment", "is a replay of run r-1"),
    "a replay, by its journal": (lambda f: f.entries(replay_entry), "commitment", "is a replay of run r-1"),
    "another place in the journal": (lambda f: f.json(RUN, put("committed", "opened_head", value="00" * 32)), "record", "another commitment or head"),
    "no place in the journal": (lambda f: f.json(RUN, put("committed", value=None)), "record", "another commitment or head"),
    "recorded rewards edited": (lambda f: f.rerecord("heldout-001", lambda row: (row.action, 100.0)), "recordings", "rewards sum to"),
    "a recording left out": (lambda f: f.files.__setitem__("runs/0000/actions/train-000", contents.pack_recordings([])), "recordings", "0 recordings"),
    "a recording that is none": (lambda f: f.files.__setitem__("runs/0000/actions/train-000", contents.pack_recordings([b"evotraj1", b"x"])), "recordings", "not a trajectory"),
    "a run's first entry cut off": (lambda f: f.entries(lambda lines: lines[1:]), "journal", "without being open"),
    "a journal begun anew": (lambda f: f.entries(lambda lines: lines[2:]), "journal", "no entry of this run"),
    "entries in another order": (lambda f: f.entries(lambda lines: [lines[2], *lines[:2], *lines[3:]]), "journal", "older than"),
    "an entry edited": (lambda f: f.entries(entry_edited), "commitment", "another entry"),
    "an entry that is none": (lambda f: f.entries(lambda lines: [*lines, b'{"kind":"paid"}']), "journal", "not an entry"),
    "a disclosure left out": (lambda f: f.entries(lambda lines: lines[:-1]), "disclosure", "was not revealed"),
    "a run twice": (double_run, "digests", "twice"),
    "no run at all": (lambda f: [f.files.pop(name) for name in list(f.files) if name.startswith("runs/")] and None, "format", "no run"),
    "a number that is none": (lambda f: f.text(EPISODES, b'"episode_return":', b'"episode_return":NaN,"x":'), "format", "damaged"),
    "a number without end": (lambda f: f.text(EPISODES, b'"episode_return":', b'"episode_return":1e999,"x":'), "format", "damaged"),
    "a length beyond all numbers": (lambda f: f.text(EPISODES, b'"length":', b'"length":' + b"9" * 400 + b',"x":'), "format", "damaged"),
    "text that is no UTF-8": (lambda f: f.text(RUN, b'"model": "', b'"model": "\xff\xfe'), "format", "is damaged"),
    "a document nested without end": (lambda f: f.files.__setitem__(OPENING, b"[" * 100_000), "format", "damaged"),
    "a record of a later version": (lambda f: f.json(RUN, put("record_version", value=99)), "format", "use the software"),
    "a document of another kind": (lambda f: f.files.__setitem__(RESULT, b"[]"), "format", "damaged"),
}  # fmt: skip
"""Of forgers who sign anew."""
NOT_SIGNED_ANEW: dict[str, tuple[Edit, str, str]] = {
    "a changed file": (lambda f: f.json(EPISODES, put(0, "episodes", 0, "episode_return", value=99.0)), "digests", "episodes.json was changed"),
    "a dropped run": (drop_run, "digests", "is missing"),
    "a file added": (lambda f: f.files.__setitem__("runs/0000/notes", b"x"), "digests", "was added"),
    "a dropped file": (lambda f: f.files.pop("runs/0000/checkpoints/000") and None, "digests", "is missing"),
    "an edited manifest": (lambda f: f.text(contents.MANIFEST, b'"software":"', b'"software":"9'), "signature", "not a signature"),
    "a manifest with a field twice": (lambda f: f.text(contents.MANIFEST, b"{", b'{"version":1,'), "format", "a key occurs twice"),
    "a signature that is none": (lambda f: f.json(contents.SIGNATURE, put("signature", value="zz")), "signature", "not a signature"),
    "a key in another spelling": (lambda f: f.json(contents.SIGNATURE, lambda told: told.update(key=f" {told['key'].upper()}")), "signature", "not a signature"),
    "no signature": (lambda f: f.files.pop(contents.SIGNATURE) and None, "format", "signature.json is missing"),
    "a later format": (lambda f: f.json(contents.MANIFEST, put("version", value=2)), "format", "reads 'evopolicy results' version 1"),
    "a journal that is cut": (lambda f: f.entries(lambda lines: lines[:-1]), "journal", "not the signed one"),
    "a journal without an end of line": (lambda f: f.files.__setitem__(contents.JOURNAL, b"{"), "journal", "cut off"),
}  # fmt: skip


def failures(files: dict[str, bytes], identity: str = "") -> list[Finding]:
    return [each for each in rules.check(Held(files), identity).findings if each.state == "failed"]


def named(findings: list[Finding], kind: str, text: str) -> bool:
    return any(each.kind == kind and text in each.text for each in findings)


def test_untouched_results_hold(results: Results) -> None:
    checked = rules.check(Held(results.files), results.summary["signer"])
    assert [each for each in checked.findings if each.state == "failed"] == []
    assert {each.kind for each in checked.findings if each.state == "open"} == {"claims", "order", "policies"}
    assert {each.kind for each in checked.findings} == KINDS.keys() - {"replay", "logs"}
    assert [each.state for each in checked.listing] == ["published", "published"]


@pytest.mark.parametrize("kind", SIGNED_ANEW)
def test_tampering_is_named_though_all_is_signed_anew(results: Results, kind: str) -> None:
    """Attack: opens a run as a replay, to get another run's hidden cases and random seeds, or to hide a
    run from the count of runs. Defence: only the operator with the run's key, after the run's end, with
    the same settings; marked in the journal, and never published or in a report."""
    edit, finding, text = SIGNED_ANEW[kind]
    forger = Forger(results.files)
    edit(forger)
    forger.sign()
    findings = failures(forger.files)
    assert named(findings, finding, text), findings
    assert named(failures(forger.files, results.summary["signer"]), "identity", "another signer")


@pytest.mark.parametrize("kind", NOT_SIGNED_ANEW)
def test_tampering_with_what_was_signed_is_named(results: Results, kind: str) -> None:
    edit, finding, text = NOT_SIGNED_ANEW[kind]
    forger = Forger(results.files)
    edit(forger)
    assert named(failures(forger.files), finding, text), failures(forger.files)


def test_signing_anew_alone_is_another_signer(results: Results) -> None:
    forger = Forger(results.files)
    forger.sign()
    assert failures(forger.files) == []
    assert [each.kind for each in failures(forger.files, results.summary["signer"])] == ["identity"]


def test_selected_runs_show_what_they_were_selected_from(results: Results) -> None:
    summary = results.publish("one.evp", results.run_folder("second"))
    assert [(each["exp_id"], each["state"]) for each in summary["left_out"]] == [("first", "completed")]
    checked = rules.check(Held(results.read_file("one.evp")))
    assert not checked.failed
    assert [each.text for each in checked.findings if each.kind == "completeness"] == [
        "1 of 2 runs of these entries and their starts are left out (1 completed): these runs were selected"
    ]


def test_heads_that_were_noted_show_whether_the_journal_was_begun_anew(results: Results) -> None:
    """A journal of one run whose owner kept only the better of two: nothing in the file contradicts it."""
    lines = contents.journal_entries(results.files[contents.JOURNAL])
    heads = journal.heads(lines)

    def order(files: dict[str, bytes], head: str) -> tuple[str, str]:
        findings = rules.check(Held(files), heads=[head]).findings
        return next((each.state, each.text) for each in findings if each.kind == "order")

    state, text = order(results.files, heads[1])
    assert (state, "1 run opened after it" in text) == ("ok", True)
    state, text = order(results.files, "00" * 32)
    assert (state, "never had the head" in text) == ("failed", True)
    anew = Forger(results.files)
    anew.entries(lambda entries: [*entries[2:4], entries[4]])
    anew.sign()
    assert order(anew.files, heads[1])[0] == "failed"
    checked = evopolicy(results.root, "check", "all.evp", "--head", heads[1].upper(), "--head", heads[0])
    assert (checked.returncode, "ok     order" in checked.stdout) == (0, True), (
        checked.stdout + checked.stderr
    )
    assert evopolicy(results.root, "check", "all.evp", "--head", "agent.py").returncode == 2


def test_publishing_again_gives_the_same_bytes(results: Results) -> None:
    results.publish("again.evp", "runs")
    assert (results.root / "again.evp").read_bytes() == (results.root / "all.evp").read_bytes()


def test_nothing_of_this_machine_is_in_what_is_published(results: Results) -> None:
    """Attack: secrets, paths, and names of the publishing machine in what is published. Defence: removed,
    and searched for."""
    identity = json.loads((results.root / "st" / "identity.json").read_bytes())
    secrets = [*identity["passwords"].values(), identity["worker_token"], identity["operator_token"]]
    everything = b"".join(results.files.values())
    for text in (str(results.root), "agent.py", sys.executable, *secrets):
        assert text.encode() not in everything
    removed = {each["what"] for each in json.loads(results.files[contents.REMOVED])}
    assert {"logs/", "workspace/", "runs/0000/run.json: agent.settings.agent"} <= removed


def test_a_policy_that_tells_of_the_machine_is_withheld(results: Results) -> None:
    folder = results.root / "leaky-policy"
    folder.mkdir()
    (folder / "policy.py").write_text(f"# written in {results.root}\n{CONSTANT.format(0)}")
    state = words("--state leaky-st")
    options = words("--env toy/line --budget 1 --validation 2 --heldout 2 --runs leaky")
    evopolicy(results.root, "local", *options, *state, "--agent", f"replay:{folder}", code=0)
    args = ("publish", "leaky", "--out", "leaky.evp", "--local", *state, "--json")
    document = json.loads(evopolicy(results.root, *args).stdout)
    assert any("checkpoints/000" in each["what"] for each in document["removed"])
    files = results.read_file("leaky.evp")
    assert not any("checkpoints" in name for name in files)
    checked = rules.check(Held(files))
    assert not checked.failed
    assert checked.state_of("checkpoints") == "open"


def test_the_command_checks_and_replays(results: Results) -> None:
    identity = results.summary["signer"]
    done = evopolicy(results.root, "check", "all.evp", "--replay", "all", "--identity", identity, code=0)
    assert "ok     replay" in done.stdout
    assert "the signer is the one that you named" in done.stdout
    plain = evopolicy(results.root, "check", "all.evp", "--json")
    document = json.loads(plain.stdout)
    assert (plain.returncode, document["ok"], document["signer"]) == (0, True, identity)


def invented(results: Results) -> str:
    forger = Forger(results.files)
    forger.invent_returns()
    forger.place()
    forger.sign(results.root / "st")
    forger.write(results.root / "invented.evp")
    return "invented.evp"


@pytest.mark.parametrize("share", ["all", "1%"])
def test_a_replay_without_held_out_recordings_is_never_ok(results: Results, share: str) -> None:
    """Attack: invented returns without the recordings that would contradict them. Defence: `--replay` ends
    with exit code 3 and names the episodes without a recording; a leaderboard shows the run apart."""
    done = evopolicy(results.root, "check", invented(results), "--replay", share, code=3)
    assert "open   recordings: only 0 of 3 held-out episodes have a recording" in done.stdout
    assert "1 of 2 runs have episodes without a recording" in done.stdout
    if share == "all":
        assert (
            "covered 10 of 10 train, 8 of 8 validation, 3 of 6 held-out, 6 of 6 random episodes"
            in done.stdout
        )


def test_a_removed_recording_of_one_episode_leaves_the_replay_open(results: Results) -> None:
    forger = Forger(results.files)
    name = "runs/0000/actions/heldout-001"
    forger.files[name] = contents.pack_recordings([None, *contents.unpack_recordings(forger.files[name])[1:]])
    forger.sign()
    checked = rules.check(Held(forger.files))
    assert not checked.failed
    assert checked.unrecorded(checked.runs[0].opening.run) == ["2 of 3 held-out"]


def test_an_edited_processor_excuses_differences_of_last_places_alone(results: Results) -> None:
    """A coordinator that cheats from the start fixes the fingerprint that it likes."""
    edits: tuple[tuple[Callable[[float], float], int, str], ...] = (
        (lambda reward: math.nextafter(reward, 9.0), 3, "units in the last place at most"),
        (lambda reward: reward + 1e-9, 1, "other features of the processor do not explain this"),
    )
    for change, code, text in edits:
        forger = Forger(results.files)
        forger.rerecord("heldout-001", lambda row, change=change: (row.action, change(row.reward)))
        value = forger.returns("heldout-001")[0]
        forger.begin_anew(lambda result: result["fingerprint"].update(cpu="another"))
        forger.raise_returns(lambda old, value=value: [value, *old[1:]])  # type: ignore[misc]
        forger.json(RUN, put("versions", "fingerprint", "cpu", value="another"))
        forger.place()
        forger.sign()
        forger.write(results.root / "processor.evp")
        done = evopolicy(results.root, "check", "processor.evp", "--replay", "all")
        (results.root / "processor.evp").unlink()
        assert (done.returncode, text in done.stdout) == (code, True), done.stdout + done.stderr


def test_no_module_that_a_file_names_is_imported(
    results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "evil_env.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    checked = rules.check(Held(results.files))
    run = checked.runs[0]
    settings = msgspec.structs.replace(run.opening.settings, env="evil_env:Glider-v0")
    opening = msgspec.structs.replace(run.opening, settings=settings)
    checked.runs = [msgspec.structs.replace(run, opening=opening)]
    asyncio.run(replays.replay(Held(results.files), checked, 1.0, lambda n, total: None))
    texts = {each.text for each in checked.findings if each.kind == "replay"}
    assert texts == {"evil_env:Glider-v0 is not installed here"}
    assert not (tmp_path / "imported").exists()


def test_wrong_usage_ends_with_2(results: Results) -> None:
    (results.root / "text.evp").write_text("hello")
    for args, reason in (
        (("check", "text.evp"), "not published results"),
        (("check", "none.evp"), "No such file"),
        (("check", "all.evp", "--identity", "abc"), "64 hexadecimal digits"),
        (("check", "all.evp", "--replay", "200%"), "say a share"),
        (("publish", "runs", "--out", "all.evp", "--local", "--state", "st"), "there already"),
        (("publish", "st", "--out", "x.evp", "--local", "--state", "st"), "no finished run"),
    ):
        done = evopolicy(results.root, *args)
        assert (done.returncode, reason in done.stderr) == (2, True), done.stderr


def test_a_hundred_thousand_entries_are_checked_in_seconds(results: Results) -> None:
    forger = Forger(results.files)
    last = json.loads(contents.journal_entries(results.files[contents.JOURNAL])[-1])
    more = [spelt(contents.JOURNAL, {**last, "epoch": str(number)}) for number in range(100_000)]
    forger.entries(lambda lines: [*lines, *more])
    forger.sign()
    began = time.process_time()
    assert failures(forger.files) == []
    assert time.process_time() - began < 60


def test_logs_are_published_only_on_request_and_without_what_the_search_finds(results: Results) -> None:
    """Attack: secrets in an agent's log that is published with `--with-logs`. Defence: replaced, and
    searched for again."""
    folder = results.root / results.run_folder("first")
    log = folder / "logs" / "agent.jsonl"
    before = log.read_bytes() if log.exists() else b""
    secret = "sk-" + "a1B2" * 8
    call = {"type": "command", "command": f"curl https://example.org/x -H {secret}; cat {results.root}/st"}
    log.write_bytes(before + json.dumps(call).encode() + b"\n")
    try:
        plain = results.publish("no-logs.evp", str(folder))
        summary = results.publish("logs.evp", str(folder), "--with-logs")
    finally:
        log.write_bytes(before)
    assert "runs/0000/logs/agent.jsonl" not in results.read_file("no-logs.evp")
    data = results.read_file("logs.evp")["runs/0000/logs/agent.jsonl"]
    assert b"https://example.org/x" in data
    assert secret.encode() not in data
    assert str(results.root).encode() not in data
    held = [each["why"] for each in summary["removed"] if "logs/agent.jsonl" in each["what"]]
    assert any("an API key" in why for why in held)
    assert any(each["what"] == "logs/" for each in plain["removed"])
    done = evopolicy(results.root, "check", "logs.evp", "--json", code=0)
    findings = json.loads(done.stdout)["findings"]
    assert [each["state"] for each in findings if each["kind"] == "logs"] == ["open"]
