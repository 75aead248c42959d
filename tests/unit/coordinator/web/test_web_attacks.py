"""Attacks on the live view: each would show, change or read what it must not, were its defence not there.

Attacks, each with its defence:
- an agent without a jail opens it on loopback: a token is needed everywhere; it is never in a path or query,
  and a reading token cannot act.
- a foreign page's host name resolves to it (DNS rebinding), or begins like an address (`[::1].evil.example`):
  the whole `Host` must be an address or one of its own names.
- a foreign page posts to it, or loads its files: `Origin` must be exactly its scheme, host and port, and
  `Sec-Fetch-Site` is checked; the cookie is `SameSite=Strict`.
- opens ever more connections and never completes a request: the head must arrive within 20 s and a form
  within 10 s; beyond 256 connections, a new one replaces the oldest without a complete request.
- code, names, logs, or SVG of an agent hold markup: templates escape everything; no inline script or style
  (content security policy); files are sandboxed text, pictures, or video.
- a path or a link in a run directory leads out of it: paths are opened part by part without following links;
  pipes are not opened; `.gateway/`, `AGENTS.md`, `run.json` and logs are not served.
- hidden results are read while an agent of a related run is alive: every page, the report, and the replays
  omit them until no such agent is alive; a named cluster that does not answer counts as having one.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime as dt
import fcntl
import os
import re
import resource
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import httpx
import msgspec
import pytest
from invented.web_site import (
    HOST,
    ORIGIN,
    TOKEN,
    client,
    finished_run,
    open_run,
    open_status,
    site_of,
    status,
)

from evopolicy_common.errors import ConfigError
from evopolicy_common.messages.status import RunStatus, WorkerStatus
from evopolicy_common.records.suite_folder import INDEX, Index, SweepRun
from evopolicy_common.wire import http as server
from evopolicy_coordinator.pki import certs
from evopolicy_coordinator.web import app
from evopolicy_coordinator.web.access import POLICY, kept_token
from evopolicy_coordinator.web.app import Site, listen, serve
from evopolicy_coordinator.web.content.run_folders import key_of

SCORE, RANDOM = "4242", "-4322"
MARKUP = '<script>alert(1)</script><img src=x onerror="alert(2)">'
UNESCAPED = ("<script>alert", "<img src=x", "<svg onload", "<b>x</b>", "Agent <script>", "<code><script>")
PAGES = ("/", "/run/{key}", "/run/{key}/submit/0", "/run/{key}/submit/0/episode/0")


def key(folder: Path) -> str:
    return key_of(str(folder.resolve()))


# ---- who may read ----


@pytest.mark.parametrize(
    "path",
    ["/", "/cluster", "/run/x", "/run/x/file?path=a", "/report/index.html", "/metrics"],
)
def test_nothing_is_disclosed_without_a_token_on_loopback_either(tmp_path: Path, path: str) -> None:
    with client(site_of(tmp_path), signed_in=False) as stranger:
        assert stranger.get(path).status_code == 401
        assert stranger.get(path, headers={"accept": "text/html"}).headers["location"] == "/login"
        assert stranger.get(path, headers={"authorization": "Bearer " + "x" * 43}).status_code == 401
        answer = stranger.get(path, headers={"authorization": f"Bearer {TOKEN}"})
        assert answer.status_code != 401
        assert path != "/metrics" or "process_cpu_seconds_total" in answer.text


def test_a_token_in_an_address_opens_nothing(tmp_path: Path) -> None:
    with client(site_of(tmp_path), signed_in=False) as stranger:
        assert stranger.get(f"/?token={TOKEN}").status_code == 401
        assert stranger.get(f"/login?token={TOKEN}").headers.get("set-cookie") is None


def test_only_the_right_token_gets_a_strict_cookie(tmp_path: Path) -> None:
    with client(site_of(tmp_path), signed_in=False) as stranger:
        wrong = stranger.post("/login", content="token=no", headers={"origin": ORIGIN})
        assert (wrong.status_code, wrong.headers.get("set-cookie")) == (401, None)
        right = stranger.post("/login", content=f"token={TOKEN}", headers={"origin": ORIGIN})
        cookie = right.headers["set-cookie"]
        assert "httponly" in cookie.lower()
        assert "samesite=strict" in cookie.lower()
        assert TOKEN not in cookie


def test_no_answer_holds_a_token(tmp_path: Path) -> None:
    folder = open_run(tmp_path)
    with client(site_of(tmp_path)) as operator:
        for path in PAGES:
            text = operator.get(path.format(key=key(folder))).text
            assert TOKEN not in text


def test_a_token_file_that_others_may_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "tokens"
    first = kept_token(path)
    assert kept_token(path) == first
    assert path.stat().st_mode & 0o777 == 0o600
    path.chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        kept_token(path)


# ---- from where ----


@pytest.mark.parametrize(
    "host",
    [
        *("evil.example", "127.0.0.1.evil.example", "evil.example:8765", "localhost.evil.example", ""),
        *("[::1].evil.example", "[::1]evil.example:80", "[::1", "::1]", "[localhost]", "[127.0.0.1]"),
        *("localhost:x", "localhost:", "localhost:80:80", "evil.example@localhost", "localhost/evil"),
        "local host",
    ],
)
def test_a_name_that_was_rebound_to_this_server_is_refused(tmp_path: Path, host: str) -> None:
    with client(site_of(tmp_path)) as browser:
        assert browser.get("/", headers={"host": host}).status_code == 421


@pytest.mark.parametrize(
    "host", ["localhost:8765", "LOCALHOST.:8765", "127.0.0.1:1", "[::1]:8765", "[::1]", "10.1.2.3"]
)
def test_the_servers_own_addresses_are_not_refused(tmp_path: Path, host: str) -> None:
    with client(site_of(tmp_path)) as browser:
        assert browser.get("/healthz", headers={"host": host}).status_code == 200


ORIGINS = (
    *("https://evil.example", "null", "http://127.0.0.1:9999", f"https://{HOST}", f"//{HOST}", f"{ORIGIN}/"),
    *(f"{ORIGIN}/evil", f"http://evil.example@{HOST}"),
)


@pytest.mark.parametrize(
    "headers",
    [
        *({"origin": origin} for origin in ORIGINS),
        *({"sec-fetch-site": site} for site in ("cross-site", "same-site")),
        {},
    ],
)
def test_a_post_that_another_sites_page_caused_does_nothing(tmp_path: Path, headers: dict[str, str]) -> None:
    signed_in = f"token={TOKEN}"
    with client(site_of(tmp_path), signed_in=False) as browser:
        refused = browser.post("/login", content=signed_in, headers=headers)
        assert (refused.status_code, refused.headers.get("set-cookie")) == (403, None)
        assert browser.get("/").status_code == 401
        assert browser.post("/login", content=signed_in, headers={"origin": ORIGIN}).status_code == 303
        assert browser.get("/").status_code == 200


def test_another_sites_page_cannot_load_our_pages_or_files(tmp_path: Path) -> None:
    headers = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}
    with client(site_of(tmp_path)) as browser:
        for path in ("/", "/run/x", "/static/web.js"):
            assert browser.get(path, headers=headers).status_code == 403


# ---- connections ----


@contextlib.asynccontextmanager
async def served_view(folder: Path, **tls: Path) -> AsyncIterator[tuple[str, int]]:
    with listen("127.0.0.1", 0) as sock:
        ready = asyncio.Event()
        serving = asyncio.create_task(serve(site_of(folder), sock, ready.set, **tls))
        await ready.wait()
        try:
            yield sock.getsockname()
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)


@contextlib.asynccontextmanager
async def held_open(
    host: str, port: int, start: bytes, connections: int
) -> AsyncIterator[list[asyncio.StreamReader]]:
    """A stranger's connections, on each of which it sends `start` and nothing more."""
    opened = [await asyncio.open_connection(host, port) for _ in range(connections)]
    for _, writer in opened:
        writer.write(start)
    try:
        yield [reader for reader, _ in opened]
    finally:
        for _, writer in opened:
            writer.close()


HEAD = b"GET /healthz HTTP/1.1\r\nHost: local"
POST = f"POST /login HTTP/1.1\r\nHost: {HOST}\r\nOrigin: {ORIGIN}\r\nContent-Length: 9\r\n\r\ntok".encode()


@pytest.fixture
def few_descriptors() -> Iterator[None]:
    """A usual limit on open files. Both ends of each connection are in this process, so it is doubled."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(2048, hard), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


async def test_unfinished_requests_keep_nobody_out_and_are_limited(
    tmp_path: Path, few_descriptors: None
) -> None:
    async with (
        served_view(tmp_path) as (host, port),
        held_open(host, port, HEAD, 1200) as readers,
        httpx.AsyncClient(timeout=60) as browser,
        asyncio.timeout(60),
    ):
        assert (await browser.get(f"http://{host}:{port}/healthz")).status_code == 200
        for _ in range(1200 - server.MAX_CONNECTIONS):
            # Cut off, long before their time is up: the oldest first.
            with contextlib.suppress(ConnectionResetError):
                assert await readers.pop(0).read() == b""


async def test_unfinished_handshakes_keep_nobody_out(tmp_path: Path, few_descriptors: None) -> None:
    now = dt.datetime.now(dt.UTC)
    authority = certs.make_authority("lab", now)
    made = certs.issue(authority, "coordinator/lab", now, 1, hosts=["127.0.0.1"], serves=True)
    certificate = tmp_path / "certificate.pem"
    certificate.write_bytes(made.certificate + made.private_key)

    async with (
        served_view(tmp_path, certificate=certificate) as (host, port),
        held_open(host, port, b"", 1200),
        httpx.AsyncClient(timeout=60, verify=False) as browser,
    ):
        assert (await browser.get(f"https://{host}:{port}/healthz")).status_code == 200


@pytest.mark.parametrize(("start", "answer"), [(HEAD, b""), (POST, b"HTTP/1.1 401")])
async def test_a_request_that_does_not_end_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, start: bytes, answer: bytes
) -> None:
    monkeypatch.setattr(server, "HEADERS_WAIT_S", 0.2)
    monkeypatch.setattr(app, "_FORM_WAIT_S", 0.2)
    async with (
        served_view(tmp_path) as (host, port),
        held_open(host, port, start, 1) as readers,
        asyncio.timeout(60),
    ):
        assert (await readers[0].read())[: len(answer) or None] == answer


# ---- markup ----


def test_what_agents_wrote_is_text_on_every_page(tmp_path: Path) -> None:
    texts = [
        {"type": "prompt", "message": MARKUP},
        {"type": "assistant", "message": {"content": [{"type": "text", "text": MARKUP}, {"type": "tool_use", "name": MARKUP, "input": {MARKUP: MARKUP}}]}},  # noqa: E501
        {"type": "stderr", "text": MARKUP},
    ]  # fmt: skip
    files = {"policy.py": MARKUP.encode(), "<img src=x>.svg": b"<svg onload=alert(3)>"}
    folder = open_run(tmp_path, entry="Agent <script>", files=files, log=texts)
    event = '{"event": "<script>alert(4)</script>", "why": "<b>x</b>"}\n'
    (folder / "logs" / "harness.log").write_text(event)
    episode = folder / "workspace/feedback/submit_000/episodes/ep_000"
    (episode / "stdout.txt").write_text(MARKUP)
    (episode / "error.txt").write_text(MARKUP)
    worker = WorkerStatus(
        worker=MARKUP, host=MARKUP, slots=1, state="active", tiers=("bwrap",), environments=(MARKUP,), fingerprint=MARKUP,  # noqa: E501
        versions={MARKUP: MARKUP}, held=0, running=0, last_seen_s=0.0, refused={MARKUP: MARKUP}, hidden_bar=MARKUP, missing_tiers={MARKUP: MARKUP}, playing={MARKUP: 1},  # noqa: E501
    )  # fmt: skip
    run = open_status("r-open", entry=MARKUP, waits_for=MARKUP, exp_id=MARKUP)
    reply = status(run, workers=(worker,), stalls=(MARKUP,))
    with client(site_of(tmp_path, cluster=reply)) as operator:
        for path in (*PAGES, "/cluster", "/?q=" + "%3Cscript%3E"):
            answer = operator.get(path.format(key=key(folder)))
            assert answer.status_code == 200, path
            assert [piece for piece in UNESCAPED if piece in answer.text] == [], path
            assert "&lt;" in answer.text, path


def test_no_page_has_inline_script_or_style_and_the_policy_forbids_them(tmp_path: Path) -> None:
    folder = finished_run(tmp_path)
    assert "unsafe" not in POLICY
    with client(site_of(tmp_path, cluster=status())) as reader:
        for path in (*PAGES[:3], "/cluster", "/login"):
            answer = reader.get(path.format(key=key(folder)))
            assert answer.headers["content-security-policy"] == POLICY
            assert answer.headers["x-content-type-options"] == "nosniff"
            assert all("src=" in tag for tag in answer.text.split("<script")[1:])
            text = answer.text.replace("http://www.w3.org/2000/svg", "")
            inline = ("<style", ' style="', " onclick", "http://", "https://")
            assert [each for each in inline if each in text] == []


SVG = "<svg xmlns='http://www.w3.org/2000/svg'><script>alert(1)</script></svg>"


def test_an_svg_or_html_of_an_agent_is_served_as_sandboxed_text(tmp_path: Path) -> None:
    folder = open_run(tmp_path)
    episode = folder / "workspace/feedback/submit_000/episodes/ep_000"
    with client(site_of(tmp_path)) as reader:
        reader.get("/")
        for name in ("a.svg", "a.html", "a.xml", "a.js"):
            (episode / name).write_text(SVG)
            path = f"workspace/feedback/submit_000/episodes/ep_000/{name}"
            answer = reader.get(f"/run/{key(folder)}/file", params={"path": path})
            assert answer.headers["content-type"].startswith("text/plain")
            assert "sandbox" in answer.headers["content-security-policy"]
            assert answer.headers["x-content-type-options"] == "nosniff"


# ---- paths ----


PRIVATE = (
    *(".gateway/credentials.json", ".gateway/service.json", "workspace/AGENTS.md", "run.json.not"),
    *("logs/env.log", "checkpoints/submit_000/_meta.json", "replays/heldout_000/video.mp4"),
)


@pytest.mark.parametrize(
    "path",
    [
        *("../../../../etc/passwd", "/etc/passwd", "run.json", *PRIVATE),
        *(
            f"workspace/feedback/{path}"
            for path in (
                *("../../run.json", "../../../secret", "link/secret", "linked", "/etc/passwd", "\0", "pipe"),
                "a/" * 200 + "b",
            )
        ),
    ],
)
def test_no_path_leads_out_of_what_may_be_read(tmp_path: Path, path: str) -> None:
    folder = open_run(tmp_path)
    (tmp_path / "secret").write_text("TOP SECRET")
    feedback = folder / "workspace" / "feedback"
    (feedback / "link").symlink_to(tmp_path)
    (feedback / "linked").symlink_to(tmp_path / "secret")
    os.mkfifo(feedback / "pipe")
    for name in PRIVATE:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("TOP SECRET")
    with client(site_of(tmp_path)) as reader:
        reader.get("/")
        answer = reader.get(f"/run/{key(folder)}/file", params={"path": path})
        assert answer.status_code == 404
        assert "SECRET" not in answer.text


@pytest.mark.parametrize("name", ["workspace", "workspace/feedback", "logs", "logs/agent.jsonl", ".gateway"])
def test_a_folder_that_became_a_link_is_not_followed(tmp_path: Path, name: str) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    folder = open_run(tmp_path / "runs", log=[{"type": "stdout", "text": "TOP SECRET"}])
    place = folder / name
    place.rename(outside / "moved")
    place.symlink_to(outside / "moved")
    with client(site_of(tmp_path / "runs")) as reader:
        reader.get("/")
        for path in PAGES[1:]:
            text = reader.get(path.format(key=key(folder))).text
            if name.startswith("logs"):
                assert "TOP SECRET" not in text
            if name.startswith("workspace"):
                assert "workspace/feedback/submit_000" not in text
                assert 'id="submit-0"' not in text


def test_a_pipe_in_place_of_a_log_holds_nobody_up(tmp_path: Path) -> None:
    folder = open_run(tmp_path)
    (folder / "logs" / "agent.jsonl").unlink()
    os.mkfifo(folder / "logs" / "agent.jsonl")
    with client(site_of(tmp_path)) as reader:
        reader.get("/")
        assert reader.get(f"/run/{key(folder)}").status_code == 200


# ---- hidden results before their time ----


def shows(folder: Path, *runs: RunStatus, roots: Path | None = None, cluster: bool = True) -> bool:
    """Whether a page shows the hidden score of a run, with these on the cluster."""
    site = site_of(roots or folder.parents[2], cluster=status(*runs) if cluster else None)
    return seen(site, folder)


def seen(site: Site, folder: Path) -> bool:
    with client(site) as reader:
        texts = [reader.get(path.format(key=key(folder))).text for path in (*PAGES[:3], "/cluster")]
    # Digests and tokens, which differ from run to run, may contain the same digits.
    numbers = re.compile(rf"(?<![\w-])({SCORE}|{RANDOM})(?!\w)")
    return any(numbers.search(text) for text in texts)


def test_hidden_scores_are_not_shown_while_a_related_agent_is_alive(tmp_path: Path) -> None:
    folder = finished_run(tmp_path)
    assert shows(folder)
    assert not shows(folder, open_status("r-2"))
    assert not shows(folder, open_status("r-2", phase="validation", agent_host="lab"))
    assert shows(folder, open_status("r-2", phase="validation", agent_host=""))
    assert shows(folder, open_status("r-2", env="gym/racing"))


def test_cases_of_a_runs_own_are_related_to_nobody(tmp_path: Path) -> None:
    assert shows(finished_run(tmp_path, hidden_cases="per_run"), open_status("r-2"))


def test_scores_stay_hidden_while_a_replay_or_start_of_it_lives(tmp_path: Path) -> None:
    folder = finished_run(tmp_path, hidden_cases="per_run", run="r-1")
    assert not shows(folder, open_status("r-2", origin="r-1"))
    other = open_run(tmp_path, settings={"replay_of": "r-1"})
    with held(other):
        assert not shows(folder, cluster=False)
    assert shows(folder, cluster=False)


@contextlib.contextmanager
def held(run: Path) -> Iterator[None]:
    """The lock of a run's agent, as its supervisor holds it."""
    with (run / ".gateway" / "agent.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def test_a_cluster_that_does_not_answer_shows_nothing_hidden(tmp_path: Path) -> None:
    folder = finished_run(tmp_path)
    site = site_of(tmp_path, cluster=status())
    assert site.cluster is not None
    site.cluster.status = None
    assert not seen(site, folder)


def test_without_a_cluster_the_lock_of_an_agent_keeps_scores_hidden(tmp_path: Path) -> None:
    folder, other = finished_run(tmp_path), open_run(tmp_path)
    assert shows(folder, cluster=False)
    with held(other):
        assert not shows(folder, cluster=False)
    assert shows(folder, cluster=False)
    (other / ".gateway" / "door.json").write_text("{}")
    assert not shows(folder, cluster=False), "a remote agent may be alive anywhere"


def test_scores_in_a_sweeps_index_are_hidden_as_well(tmp_path: Path) -> None:
    entry = SweepRun(
        name="a", agent="Agent B", env="gym/acrobot", repeat=0, digest="d", state="completed", score=4242.5,
        random=-4322.5, host="lab2",
    )  # fmt: skip
    (tmp_path / INDEX).write_bytes(msgspec.json.encode(Index(suite="s", runs={"a": entry})))
    assert not shows(tmp_path, open_status("r-2"), roots=tmp_path)
    assert shows(tmp_path, roots=tmp_path)


def test_a_served_report_waits_for_agents_and_allows_its_script(tmp_path: Path) -> None:
    report = tmp_path / "report"
    report.mkdir()
    (report / "index.html").write_text("<p>4242.5</p>")
    alive = status(open_status("r-2", env="gym/racing"))
    with client(site_of(tmp_path, cluster=alive, report=report)) as reader:
        assert reader.get("/report/index.html").status_code == 403
    with client(site_of(tmp_path, cluster=status(), report=report)) as reader:
        answer = reader.get("/report/index.html")
        assert answer.text == "<p>4242.5</p>"
        assert "script-src 'sha256-" in answer.headers["content-security-policy"]
        assert reader.get("/report/../run.json").status_code in (403, 404)


def test_the_host_header_decides_nothing_that_is_answered(tmp_path: Path) -> None:
    with client(site_of(tmp_path)) as reader:
        assert HOST not in reader.get("/").text
