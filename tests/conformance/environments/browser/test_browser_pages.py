"""Pages that attack: each is opened as an environment's page is, and gets nothing of what it wants.

Attacks, each with its defence:
- reads files by `file://`, `..` or a link: the browser requests each file from the environment process, and only
  installed programs are in its file system.
- keeps something for a later episode: storage, cookies, databases, service workers, the window's name, the
  clipboard: storage lasts in memory for one episode; no secure context; a process whose browser has played a
  hidden episode plays no train episode.
- opens windows, blocks with `alert`, or navigates to another page, also through a policy's clicks and keys:
  one window; dialogs are dismissed; navigation ends the episode; calls such as `goto` are refused.
- saves files by downloads: downloads are refused.
- loops for ever, or fills the memory: a time limit for each command and a memory limit for scripts; the
  browser is replaced, and the episode is replayed up to that step; a browser that has grown is replaced
  between episodes.
"""

from __future__ import annotations

import http.server
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from evopolicy_worker.environments.browser import page as page_module
from evopolicy_worker.environments.browser.devtools import BrowserLostError
from evopolicy_worker.environments.browser.keys import ALT, CONTROL, SHIFT, combined
from evopolicy_worker.environments.browser.page import CLICK, Button, Page, PageSource

pytestmark = pytest.mark.families


@pytest.fixture(scope="module")
def browser() -> Iterator[Page]:
    """One page for all tests of this file."""
    page = Page()
    yield page
    page.lose()


def address(folder: Path, script: str, *, body: str = "", name: str = "attack.html") -> PageSource:
    """A document with this script."""
    (folder / name).write_text(f"<!DOCTYPE html><html><body>{body}<script>{script}</script></body></html>")
    return PageSource(root=folder, path=name, width=500, height=320)


def guarded(browser: Page, folder: Path, script: str = "window.here = 1", *, body: str = "") -> str:
    """The address of a document with this script, opened in a page that may not be left."""
    browser.open(address(folder, script, body=body), "1")
    browser.run("__evopolicy.clock.guarded = true")
    return str(browser.run("location.href"))


def pages_of(browser: Page) -> list[str]:
    """Addresses of all windows of the page's context."""
    targets = browser.browser.devtools.call("Target.getTargets", timeout_s=5.0)["targetInfos"]
    return [
        one["url"]
        for one in targets
        if one["type"] in ("page", "service_worker", "shared_worker")
        and one["browserContextId"] == browser._context
    ]


class Listener:
    """A server of this machine that notes who asks it."""

    def __init__(self) -> None:
        asked = self.asked = list[str]()

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                asked.append(self.path)
                self.send_response(200)
                self.send_header("Access-Control-Allow-Origin", "*")
                self.end_headers()
                self.wfile.write(b"let in")

            def log_message(self, *args: object) -> None:
                pass

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = self.server.server_address[1]
        threading.Thread(target=self.server.serve_forever, daemon=True).start()


@pytest.fixture
def listener() -> Iterator[Listener]:
    found = Listener()
    yield found
    found.server.shutdown()
    found.server.server_close()


def test_a_page_reaches_no_server_even_on_this_machine(
    browser: Page, tmp_path: Path, listener: Listener
) -> None:
    """Attack: requests a server, on this machine or elsewhere, in any way that a page has. Defence: the
    browser requests each file from the environment process, which serves the package's folder only; no
    name resolves; the jail has no network."""
    url = f"http://127.0.0.1:{listener.port}"
    script = f"""
      window.got = [];
      const want = (what) => window.got.push(what);
      fetch("{url}/fetch").then((answer) => answer.text()).then(want, () => {{}});
      const asked = new XMLHttpRequest();
      asked.onload = () => want(asked.responseText);
      asked.open("GET", "{url}/xhr");
      asked.send();
      new Image().src = "{url}/image";
      const script = document.createElement("script");
      script.src = "{url}/script";
      document.body.append(script);
      const frame = document.createElement("iframe");
      frame.src = "{url}/frame";
      document.body.append(frame);
      const link = document.createElement("link");
      link.rel = "preload"; link.as = "fetch"; link.href = "{url}/preload";
      document.head.append(link);
      try {{ navigator.sendBeacon("{url}/beacon"); }} catch {{}}
      try {{ new WebSocket("ws://127.0.0.1:{listener.port}/socket"); }} catch {{}}
      try {{ new EventSource("{url}/events"); }} catch {{}}
      try {{ new RTCPeerConnection({{ iceServers: [{{ urls: "stun:127.0.0.1:{listener.port}" }}] }}); }} catch {{}}
      // The same by what a frame has.
      const empty = document.createElement("iframe");
      document.body.append(empty);
      const inner = empty.contentWindow;
      try {{ new inner.WebSocket("ws://127.0.0.1:{listener.port}/inner-socket"); }} catch {{}}
      try {{ new inner.EventSource("{url}/inner-events"); }} catch {{}}
      try {{ inner.fetch("{url}/inner-fetch").then((answer) => answer.text()).then(want, () => {{}}); }} catch {{}}
      try {{ inner.navigator.serviceWorker.register("{url}/worker.js").catch(() => {{}}); }} catch {{}}
      try {{ new inner.Worker(URL.createObjectURL(new Blob(["fetch('{url}/worker')"]))); }} catch {{}}
    """
    browser.open(address(tmp_path, script), "1")
    time.sleep(1.0)
    assert browser.run("window.got") == []
    assert listener.asked == []


def test_a_page_reads_no_file_of_the_machine(browser: Page, tmp_path: Path) -> None:
    inside = tmp_path / "pages"
    inside.mkdir()
    (tmp_path / "secret.txt").write_text("the secret")
    (inside / "link.txt").symlink_to(tmp_path / "secret.txt")
    script = f"""
      window.got = [];
      for (const url of ["file://{tmp_path}/secret.txt", "../secret.txt", "/../secret.txt", "/%2e%2e/secret.txt",
                         "link.txt", "view-source:file://{tmp_path}/secret.txt", "chrome://version"]) {{
        const asked = new XMLHttpRequest();
        asked.onload = () => window.got.push(asked.responseText);
        try {{ asked.open("GET", url); asked.send(); }} catch {{}}
        try {{ fetch(url).then((answer) => answer.text()).then((text) => window.got.push(text), () => {{}}); }} catch {{}}
        const frame = document.createElement("iframe");
        frame.src = url;
        frame.onload = () => {{
          try {{ window.got.push(frame.contentDocument.body.innerText); }} catch (error) {{ }}
        }};
        document.body.append(frame);
      }}
    """  # noqa: E501
    browser.open(address(inside, script), "1")
    time.sleep(1.0)
    assert not [text for text in browser.run("window.got") if "secret" in text]
    assert b"the secret" not in browser.picture(width=500, height=320)


KEEP = """
  window.found = [];
  const look = (name, value) => { if (value) window.found.push(name); };
  look("localStorage", localStorage.getItem("kept"));
  look("sessionStorage", sessionStorage.getItem("kept"));
  look("cookie", document.cookie);
  look("name", window.name);
  look("hash", location.hash);
  look("history", history.state);
  window.waiting = Promise.all([
    typeof indexedDB === "undefined" ? 0 : indexedDB.databases().then((all) => look("indexedDB", all.length)),
    typeof caches === "undefined" ? 0 : caches.keys().then((all) => look("caches", all.length)),
    navigator.serviceWorker ? navigator.serviceWorker.getRegistrations().then((all) => look("worker", all.length)) : 0,
  ]);
  localStorage.setItem("kept", "1");
  sessionStorage.kept = "1";
  document.cookie = "kept=1; max-age=100000";
  window.name = "kept";
  history.replaceState("kept", "", "#kept");
  if (typeof indexedDB !== "undefined") indexedDB.open("kept", 1);
  if (typeof caches !== "undefined") caches.open("kept");
  if (navigator.serviceWorker) navigator.serviceWorker.register("worker.js").catch(() => {});
"""


def test_a_loaded_page_finds_nothing_of_an_earlier_episode(browser: Page, tmp_path: Path) -> None:
    (tmp_path / "worker.js").write_text("self.addEventListener('fetch', () => {});")
    attack = address(tmp_path, KEEP)
    for seed in ("1", "2"):
        browser.open(attack, seed)
        browser.run("window.waiting")
        assert browser.run("window.found") == []
    # Within an episode it keeps what it wants.
    assert browser.run("[localStorage.kept, sessionStorage.length, document.cookie]") == ["1", 1, "kept=1"]


def test_the_same_numbers_and_times_for_the_same_seed(browser: Page, tmp_path: Path) -> None:
    script = """
      window.drawn = [Math.random(), Math.random(), Date.now(), new Date().getHours(), performance.now(),
                      crypto.randomUUID(), ...crypto.getRandomValues(new Uint8Array(4))];
      setTimeout(() => window.drawn.push("timer", Date.now()), 100);
      requestAnimationFrame((t) => window.drawn.push("frame", t));
    """
    drawn = []
    for seed in ("7", "7", "8"):
        browser.open(address(tmp_path, script), seed)
        time.sleep(0.15)
        browser.run("__evopolicy.advance(200)")
        drawn.append(browser.run("window.drawn"))
    assert drawn[0] == drawn[1] != drawn[2]
    assert drawn[0][2:5] == [1483228800000, 0, 0]
    assert drawn[0][-4:] == ["frame", 16, "timer", 1483228800100]


def test_there_is_one_window_and_nobody_to_ask(browser: Page, tmp_path: Path) -> None:
    script = """
      window.answers = [alert("stop"), confirm("go on?"), prompt("who?"), window.open("about:blank"), print()];
      window.onbeforeunload = () => "stay";
    """
    body = '<a id="new" href="attack.html" target="_blank" style="font-size:60px">new</a>'
    browser.open(address(tmp_path, script, body=body), "1")
    assert browser.run("window.answers") == [None, False, None, None, None]
    browser.point(30, 40, *CLICK)
    browser.run("new Promise((done) => done())")
    assert len(pages_of(browser)) == 1


@pytest.mark.parametrize(
    "script",
    [
        "location.href = 'attack.html?again'",
        "document.forms[0].submit()",
        "document.forms[0].requestSubmit()",
        "document.links[0].click()",
        "location.reload()",
    ],
)
def test_a_page_cannot_be_left_and_says_so(browser: Page, tmp_path: Path, script: str) -> None:
    body = '<form action="attack.html"><input name="a"></form><a href="attack.html?b">b</a>'
    guarded(browser, tmp_path, body=body)
    browser.run(f"(() => {{ {script} }})()")
    browser.run("__evopolicy.advance(200)")
    assert browser.run("window.here") == 1
    assert browser.run("__evopolicy.clock.left") != ""


@pytest.mark.parametrize(
    "link",
    [
        'href="file:///etc/passwd"',
        'href="file:///etc/passwd" target="_blank"',
        'href="chrome://version"',
        'href="view-source:http://pages.invalid/attack.html"',
        'href="data:text/html,left"',
        'href="data:application/octet-stream,saved" download="saved.bin"',
        'href="attack.html" download="saved.html"',
        """href="javascript:window.open('about:blank')" """,
    ],
)
def test_no_click_on_a_link_leads_elsewhere_or_saves_a_file(browser: Page, tmp_path: Path, link: str) -> None:
    body = f'<a {link} style="display:block; width:200px; height:100px">there</a>'
    where = guarded(browser, tmp_path, body=body)
    button: Button
    for button, modifiers in (("left", 0), ("left", CONTROL), ("left", SHIFT), ("left", ALT), ("middle", 0)):
        browser.point(60, 50, *CLICK, button=button, modifiers=modifiers)
        browser.run("__evopolicy.advance(200)")
    time.sleep(0.2)
    assert browser.run("[window.here, location.href]") == [1, where]
    assert pages_of(browser) == [where]
    assert not list(browser.browser.profile.rglob("saved*"))
    assert not list(browser.browser.profile.rglob("*.crdownload"))


def test_keys_of_a_browser_s_own_do_nothing(browser: Page, tmp_path: Path) -> None:
    where = guarded(browser, tmp_path)
    for name in ("Control+t", "Control+n", "Control+Shift+n", "Control+o", "Control+s", "Control+p", "Control+u",
                 "Control+w", "Control+r", "Control+l", "Control+Shift+i", "Alt+ArrowLeft", "F5", "F11", "F12"):  # fmt: skip  # noqa: E501
        found = combined(name)
        assert found is not None
        browser.press(*found)
    time.sleep(0.2)
    assert browser.run("[window.here, location.href]") == [1, where]
    assert pages_of(browser) == [where]


def test_no_frame_opens_a_window_or_leaves_a_worker(browser: Page, tmp_path: Path) -> None:
    (tmp_path / "worker.js").write_text("self.addEventListener('fetch', () => {});")
    script = """
      const frame = document.createElement("iframe");
      document.body.append(frame);
      const inner = frame.contentWindow;
      window.got = [];
      for (const attempt of [
        () => inner.open("about:blank"),
        () => inner.open("attack.html", "_blank", "popup"),
        () => inner.eval("window.open('about:blank')"),
        () => new inner.SharedWorker("worker.js"),
        () => inner.navigator.serviceWorker.register("worker.js"),
        () => navigator.serviceWorker.register("worker.js"),
      ]) try { window.got.push(Boolean(attempt())); } catch { window.got.push(false); }
      const form = document.createElement("form");
      form.target = "_blank"; form.action = "attack.html";
      document.body.append(form);
      HTMLFormElement.prototype.requestSubmit.call(form);
    """
    where = guarded(browser, tmp_path, "")
    browser.run(f"(() => {{ {script} }})()")
    browser.run("__evopolicy.advance(200)")
    time.sleep(0.2)
    assert browser.run("window.got") == [False] * 6
    assert pages_of(browser) == [where]


def test_a_place_within_a_page_is_no_leaving(browser: Page, tmp_path: Path) -> None:
    guarded(browser, tmp_path, body='<a id="a" href="#there">a</a>')
    browser.run("document.links[0].click()")
    browser.run("history.pushState(null, '', '?x')")
    assert browser.run("[location.hash, window.here, __evopolicy.clock.left]") == ["", 1, ""]


@pytest.mark.parametrize("script", ["for (;;) {}", "const a = []; for (;;) a.push(new Array(1e6).fill(1.5))"])
def test_a_page_that_hangs_or_needs_too_much_memory_is_reported(
    browser: Page, tmp_path: Path, script: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_module, "CALL_S", 5.0)
    browser.open(address(tmp_path, ""), "1")
    with pytest.raises(BrowserLostError):
        browser.run(f"(() => {{ {script} }})()")
    browser.lose()
    # The next one plays.
    browser.open(address(tmp_path, "window.here = 1", name="next.html"), "1")
    assert browser.run("window.here") == 1


def test_a_browser_whose_memory_has_grown_is_replaced(
    browser: Page, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    browser.open(address(tmp_path, "window.here = 1"), "1")
    first = browser.browser.pid
    limits = Path(f"/proc/{first}/limits").read_text().splitlines()
    (data,) = [line.split()[3] for line in limits if line.startswith("Max data size")]
    assert int(data) <= 4 << 30
    monkeypatch.setattr(page_module, "_CHECK_EVERY", 1)
    browser.keep_small()
    assert browser.browser.pid == first
    monkeypatch.setattr(page_module, "MAX_MB", 1)
    browser.keep_small()
    assert not Path(f"/proc/{first}").exists()
    browser.open(address(tmp_path, "window.here = 1"), "1")
    assert browser.run("window.here") == 1


def test_texts_that_no_observation_can_have_become_others(browser: Page, tmp_path: Path) -> None:
    browser.open(address(tmp_path, ""), "")
    pair, half = r"\ud83d\ude00", r"\ud83d"
    texts = browser.tell(
        f'["{pair}", "{pair}".slice(0, 1), "{half}{half}a", "{pair}".slice(1), "\\{half}", "\\\\{half}"]'
    )
    assert texts == ["😀", "�", "��a", "�", "\\ud83d", "\\�"]
    with pytest.raises(BrowserLostError, match="invalid JSON"):
        browser.tell("undefined")


def test_an_address_that_no_file_can_have_is_refused(tmp_path: Path) -> None:
    page = Page()
    page.opened = address(tmp_path, "")
    assert page._body(f"{page_module.ORIGIN}/attack.html") is not None
    for name in ("a" * 5000, "a\0b", "../" * 5000, "."):
        assert page._body(f"{page_module.ORIGIN}/{name}") is None
