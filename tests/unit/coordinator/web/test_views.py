"""The pages of a run and of the cluster, from the coordinator's status and the files."""

from __future__ import annotations

import json
import re
from pathlib import Path

import msgspec
from invented.web_site import client, finished_run, open_run, open_status, site_of, status

from evopolicy_common.messages.run_settings import Start
from evopolicy_common.messages.status import RetriedJobs
from evopolicy_common.records.open_run import LISTENER
from evopolicy_coordinator.web.content.cluster import _RETRIES_OF_A_RUN
from evopolicy_coordinator.web.content.run_folders import key_of

LOST = RetriedJobs(at=1_767_312_000.0, worker="w-attic", failure="worker_lost", jobs=3)
FAILED = RetriedJobs(at=1_767_312_060.0, worker="w-cellar", failure="failed")


def key(folder: Path) -> str:
    return key_of(str(folder.resolve()))


def test_lost_workers_and_retries_stand_among_a_runs_events(tmp_path: Path) -> None:
    folder = open_run(tmp_path)
    why = {"reason": "agent_failed", "detail": "Error code: 401", "turns": 3}
    verdict = {"submit": "submit_0003", "status": "import_error", "detail": ""}
    lines = [
        {"event": "agent ended", "timestamp": "2026-01-02T00:00:40Z", **why},
        {"event": "agent paused for the provider", "timestamp": "2026-01-02T00:00:30Z", "level": "info"},
        {"event": "submit committed", "timestamp": "2026-01-01T23:30:00Z", **verdict},
        {"event": "run opened", "timestamp": "2026-01-01T23:00:00Z", "level": "info"},
    ]
    (folder / "logs" / "harness.log").write_text("".join(json.dumps(line) + "\n" for line in lines))
    reply = status(open_status("r-open", retries=(LOST, FAILED)))
    with client(site_of(tmp_path, cluster=reply)) as browser:
        page = browser.get(f"/run/{key(folder)}").text
    expected = [
        "1 job failed on worker w-cellar, through no fault of the policy. It is played again, at no charge.",
        "The agent ended: agent failed (turns 3): Error code: 401</li>",
        "agent paused for the provider",
        "Worker w-attic was lost with 3 jobs of this run. They are played again, at no charge.",
        "submit 0003 ended: import error</li>",
        "run opened",
    ]
    places = [page.index(text) for text in expected]
    assert places == sorted(places), "newest first"
    assert "2026-01-02 00:00:00" in page


def test_retries_that_the_coordinator_no_longer_tells_of_are_kept_and_bounded(tmp_path: Path) -> None:
    site = site_of(tmp_path, cluster=status(open_status("r-open", retries=(LOST,))))
    assert site.cluster is not None
    for number in range(3 * _RETRIES_OF_A_RUN):
        later = RetriedJobs(at=LOST.at + 1.0 + number, worker="w", failure="overdue")
        site.cluster.take_status(status(open_status("r-open", retries=(later,))))
        if number == 0:
            assert list(site.cluster.retries["r-open"]) == [LOST, later]
    assert len(site.cluster.retries["r-open"]) == _RETRIES_OF_A_RUN


def test_a_start_names_its_submit_and_links_to_its_parent(tmp_path: Path) -> None:
    first = finished_run(tmp_path, exp_id="first", run="r-first")
    start = Start(run="r-first", submit_index=0, tree="ab" * 32, parent_scored=True)
    here = finished_run(tmp_path, exp_id="here", run="r-here", start=start)
    live = open_run(tmp_path, settings={"start": msgspec.structs.replace(start, parent_scored=False)})
    away = finished_run(
        tmp_path, exp_id="away", start=Start(run="<b>gone</b>", submit_index=4, tree="ab" * 32)
    )
    with client(site_of(tmp_path)) as browser:
        pages = [browser.get(f"/run/{key(folder)}").text for folder in (first, here, live, away)]
        submit = browser.get(f"/run/{key(first)}/submit/0")
        all_runs = browser.get("/").text
    assert "Starts from" not in pages[0]
    for page in pages[1:3]:
        assert f'Starts from <a href="/run/{key(first)}/submit/0">submit 0</a> of run' in page
        assert f'<a href="/run/{key(first)}">Agent A, first, repeat 0</a>.' in page
    assert submit.status_code == 200
    assert "a result may have chosen this submit (<code>parent_scored</code>)." in pages[1]
    assert "parent_scored" not in pages[2], "the coordinator alone knows it while the run is open"
    assert "Starts from submit 4 of run <code>&lt;b&gt;gone&lt;/b&gt;</code>, which is not here." in pages[3]
    assert "no result has chosen this submit" in pages[3]
    assert ", from submit 0 of r-first</td>" in all_runs
    assert ", from submit 4 of &lt;b&gt;gone&lt;/b&gt;</td>" in all_runs


def test_a_replay_names_its_run_on_the_pages(tmp_path: Path) -> None:
    first = finished_run(tmp_path, exp_id="first", run="r-first")
    again = finished_run(tmp_path, exp_id="again", run="r-again")
    record = json.loads((again / "run.json").read_text())
    (again / "run.json").write_text(json.dumps(record | {"replay_of": "r-first"}))
    live = open_run(tmp_path, settings={"replay_of": "<b>gone</b>"})
    with client(site_of(tmp_path)) as browser:
        pages = [browser.get(f"/run/{key(folder)}").text for folder in (first, again, live)]
        found = browser.get("/?q=replay").text
    assert "Replay of run" not in pages[0]
    assert f'Replay of run <a href="/run/{key(first)}">Agent A, first, repeat 0</a>' in pages[1]
    assert "Replay of run <code>&lt;b&gt;gone&lt;/b&gt;</code>, which is not here" in pages[2]
    assert found.count("<tr id=") == 2
    assert ", replay of r-first</td>" in found


def test_a_runs_page_hides_its_selection_while_a_related_agent_may_live(tmp_path: Path) -> None:
    """Attack: an agent with a browser reads from an earlier run's page which submit the hidden cases selected."""
    folder = finished_run(tmp_path / "a")
    with client(site_of(tmp_path / "a")) as browser:
        shown = browser.get(f"/run/{key(folder)}").text
    live = open_run(tmp_path / "b")
    (live / LISTENER).touch()
    with client(site_of(tmp_path / "a", tmp_path / "b")) as browser:
        hidden = browser.get(f"/run/{key(folder)}").text
    for text in (">selected</span>", "validation mean -111.2", 'id="phases"', "4242"):
        assert text in shown, text
        assert text not in hidden, text
    for page in (shown, hidden):
        assert page.count("best so far</b>") == 1
        assert "train mean <b>-100</b>" in page


def test_a_page_is_sent_again_only_when_it_has_changed(tmp_path: Path) -> None:
    site = site_of(tmp_path, cluster=status(open_status("r-open")))
    with client(site) as browser:
        first = browser.get("/cluster?q=lab")
        again = browser.get("/cluster?q=lab", headers={"if-none-match": first.headers["etag"]})
        site.cluster.take_status(status(open_status("r-new")))
        changed = browser.get("/cluster?q=lab", headers={"if-none-match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert changed.status_code == 200
    assert changed.headers["etag"] != first.headers["etag"]


def test_a_page_names_each_element_that_changes_once(tmp_path: Path) -> None:
    folder = open_run(tmp_path)
    with client(site_of(tmp_path, cluster=status(open_status("r-open")))) as browser:
        pages = [browser.get(path).text for path in ("/", "/cluster", f"/run/{key(folder)}")]
    for page in pages:
        (names,) = re.findall(r'<body data-live="([^"]+)">', page)
        assert {"facts", "notices"} <= {*names.split()}
        for name in names.split():
            assert page.count(f' id="{name}"') == 1, name
    assert "submit-rows" in names.split()
    assert "messages" in names.split()
