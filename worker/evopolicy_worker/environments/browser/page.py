"""One page of a browser: its files, its input, what its scripts return.

Rules:
- A page is served from one folder, under `ORIGIN`; the browser asks this process for each file. Every other request
  fails before it reaches a network.
- `page.js` runs before the page's own scripts and gives it a clock and random numbers of its own.
- One browser per process. It is started when the first page is opened, and again when it is lost or grew too large.
- Input goes through the browser's own events, as from a mouse and a keyboard.
"""

from __future__ import annotations

import base64
import hashlib
import itertools
import json
import math
import mimetypes
import re
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import msgspec

from evopolicy_worker.environments.browser.chromium import MAX_MB, REMEDY, Chromium, program
from evopolicy_worker.environments.browser.devtools import BrowserLostError
from evopolicy_worker.environments.browser.keys import MODIFIERS, NAMED, SHIFT, Key, shifted, typed

ORIGIN = "http://pages.invalid"
"""Origin of the pages. Not `localhost`, which is a secure context with service workers."""
CALL_S = 10.0
"""A page that takes longer over one command hangs."""
LOAD_S = 30.0
_CHECK_EVERY = 64
"""Number of episodes between two checks of the browser's memory."""
_MARGIN = 20
"""Distance of the resting mouse from the window's right and lower edge, CSS pixels: more than a scrollbar is wide."""
_NO_REASON = "BlockedByClient"
_HALF_PAIR = re.compile(r"(?<!\\)((?:\\\\)*)\\ud[89a-f][0-9a-f]{2}")

_MEASURE = r"""
(() => {
  const pen = document.createElement("canvas").getContext("2d");
  const found = [];
  for (const family of ["serif", "sans-serif", "monospace", "Arial", "Verdana", "Helvetica", "Times New Roman", "Courier"])
    for (const size of [10, 12, 13.333, 16]) {
      pen.font = `${size}px ${family}`;
      for (const text of ["Hamburgefonstiv 0123456789", "\u2713 \u00e9\u4e2d\ud83d\ude00"]) {
        const told = pen.measureText(text);
        found.push(told.width, told.fontBoundingBoxAscent, told.fontBoundingBoxDescent);
      }
    }
  return found;
})()
"""  # noqa: E501

Button = Literal["left", "middle", "right"]
MOVE, PRESS, RELEASE = "mouseMoved", "mousePressed", "mouseReleased"
CLICK = ((PRESS, 1), (RELEASE, 1))
DOUBLE_CLICK = (*CLICK, (PRESS, 2), (RELEASE, 2))


class PageSource(msgspec.Struct, frozen=True):
    """Files and initial script of a page."""

    root: Path
    """Folder of its files."""
    path: str
    """The document, below the folder, with `/`."""
    width: int
    height: int
    """Of the window, CSS pixels."""
    virtual: bool = True
    """Whether its clock is its own; otherwise it is the wall's."""
    scripts: tuple[str, ...] = ()
    """Expressions that run once the document has loaded."""
    accessible: bool = False
    """Whether roles and names of its elements are asked for at each step."""


class Page:
    """The one page of this process's browser. `opened` is what it shows."""

    def __init__(self) -> None:
        self.opened: PageSource | None = None
        self._browser: Chromium | None = None
        self._context = self._session = self._script = ""
        self._loaded = False
        self._bodies: dict[Path, tuple[str, str]] = {}
        self._episodes = 0
        self._identity: dict[str, str] | None = None
        self._buttons = 0
        self._held = "none"
        self._touched = True
        """Whether mouse or keyboard were used since the mouse rests."""
        self._down: dict[str, Key] = {}
        self.mouse_at = (0.0, 0.0)
        """Position of the mouse, CSS pixels."""
        self.keys_ms = 1
        """Time of the next key, which only grows: a list finds an option by keys that are typed within a second."""

    @property
    def browser(self) -> Chromium:
        """The running browser; started if there is none. Raises WorkerError when there is no program."""
        if self._browser is None:
            self._browser = Chromium(self._event)
            self._browser.devtools.send("Target.setDiscoverTargets", wanted=False, discover=True)
        return self._browser

    def open(self, address: PageSource, seed: str) -> None:
        """Loads it anew. `seed`: of the random numbers that its scripts draw while it loads. Raises BrowserLostError
        when it does not load."""
        if self.opened != address:
            self._begin_context()
            for method, params in _first(address):
                self._send(method, wanted=False, **params)
        else:
            self.release()
        if self._script:
            self._send("Page.removeScriptToEvaluateOnNewDocument", wanted=False, identifier=self._script)
        self.opened = address
        self._loaded, self._touched = False, True
        added = self._send(
            "Page.addScriptToEvaluateOnNewDocument", source=_script(seed, virtual=address.virtual)
        )
        self._send("Page.navigate", wanted=False, url=f"{ORIGIN}/{address.path}")
        devtools = self.browser.devtools
        self._script = str(devtools.result(added, CALL_S)["identifier"])
        devtools.wait(lambda: self._loaded, LOAD_S)
        for script in address.scripts:
            self.run(script)
        self.run("__evopolicy.preload().then(__evopolicy.settle)")

    def _begin_context(self) -> None:
        """An empty page in a new context. BrowserLostError, which names the program and the remedy, when there is
        none."""
        self.opened, self._script = None, ""
        self._buttons, self._held, self._down = 0, "none", {}
        try:
            devtools = self.browser.devtools
            if self._context:
                devtools.send("Target.disposeBrowserContext", wanted=False, browserContextId=self._context)
                self._context = self._session = ""
            made = devtools.call("Target.createBrowserContext", timeout_s=CALL_S)
            self._context = str(made["browserContextId"])
            own = {"browserContextId": self._context}
            devtools.send("Browser.setDownloadBehavior", wanted=False, behavior="deny", **own)
            target = devtools.call("Target.createTarget", timeout_s=CALL_S, url="about:blank", **own)
            attached = devtools.call(
                "Target.attachToTarget", timeout_s=CALL_S, targetId=target["targetId"], flatten=True
            )
            self._session = str(attached["sessionId"])
        except BrowserLostError as error:
            self.lose()
            raise BrowserLostError(f"{program()} opens no page: {error}; {REMEDY}") from error

    def identity(self) -> dict[str, str]:
        """The browser's version, and a digest of how wide it sets text: what decides where elements are."""
        if self._identity is None:
            if not self._session:
                self._begin_context()
            fonts = hashlib.sha256(json.dumps(self.run(_MEASURE)).encode()).hexdigest()[:12]
            self._identity = {"chromium": self.browser.version.partition("/")[2], "fonts": fonts}
        return self._identity

    def run(self, script: str) -> Any:
        """Value of an expression in the page, promises awaited. BrowserLostError when it throws or does not end."""
        outcome = self.send(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True, userGesture=True
        )
        if details := outcome.get("exceptionDetails"):
            text = details.get("exception", {}).get("description") or details.get("text", "")
            raise BrowserLostError(f"a script failed in the page: {str(text)[:500]}")
        return outcome["result"].get("value")

    def tell(self, script: str) -> Any:
        """As `run`, for large values: the page writes them as JSON, which is quicker than the browser's own way. Half
        of a surrogate pair, which no observation can have, becomes U+FFFD."""
        text = self.run(f"(async () => __evopolicy.json(await ({script})))()")
        try:
            # Whole pairs are not escaped.
            return msgspec.json.decode(_HALF_PAIR.sub(r"\1\\ufffd", text) if "\\ud" in text else text)
        except (TypeError, msgspec.MsgspecError) as error:
            raise BrowserLostError(f"the page sent invalid JSON: {error}") from error

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """One command of the DevTools protocol to the page, and its result."""
        return self.browser.devtools.result(self._send(method, **params), CALL_S)

    def point(
        self,
        x: float,
        y: float,
        *events: tuple[str, int],
        button: Button = "left",
        modifiers: int = 0,
        move: bool = True,
        resting: bool = False,
    ) -> None:
        """Moves the mouse to a place, CSS pixels, and then presses and releases its button there: types of events
        (`PRESS`, `RELEASE`), each with the number of clicks. `modifiers`: the keys held meanwhile. `move=False`: the
        mouse is there. A press on a scrollbar is left out, unless `resting`, where there is none."""
        # Whole pixels, as the page is told: from parts of one the browser selects other characters from time to time.
        x, y = math.floor(x), math.floor(y)
        pressed = not resting and any(kind == PRESS for kind, _ in events)
        # Asked before the first event: to wait for a mouse that moves is to wait for the next frame.
        on_bar = pressed and self.run(f"__evopolicy.bar({x}, {y})")
        self._touched, self.mouse_at = True, (x, y)
        numbers: list[int] = []
        for kind, clicks in ([(MOVE, 0)] if move else []) + [*events]:
            if kind == PRESS and on_bar:
                continue
            if kind != MOVE:
                bit = _BITS[button]
                self._buttons = self._buttons | bit if kind == PRESS else self._buttons & ~bit
                self._held = button if self._buttons else "none"
            event: dict[str, Any] = {
                "type": kind,
                "x": x,
                "y": y,
                "clickCount": clicks,
                "modifiers": modifiers,
            }
            event |= {"button": self._held if kind == MOVE else button, "buttons": self._buttons}
            # The time tells the page's script that it is an action's.
            numbers.append(self._send("Input.dispatchMouseEvent", **event, timestamp=1))
            if kind == MOVE and self._held != "none":
                self._await(numbers)
                numbers.clear()
                self.run("__evopolicy.moved()")
        self._await(numbers)

    def wheel(self, x: float, y: float, delta_x: float, delta_y: float) -> None:
        """Turns the mouse's wheel at a place, CSS pixels."""
        self._touched = True
        self.send("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=delta_x, deltaY=delta_y)
        self.run("__evopolicy.moved()")

    def keys(self, *events: tuple[Literal["down", "up"], Key, int]) -> None:
        """Keys pressed and released in order, each with the modifiers held (1 Alt, 2 Control, 4 Meta, 8 Shift)."""
        numbers = []
        self._touched = self._touched or bool(events)
        for kind, pressed, modifiers in events:
            key = shifted(pressed) if modifiers & SHIFT else pressed
            if kind == "down":
                self._down[pressed.code] = pressed
            else:
                self._down.pop(pressed.code, None)
            event: dict[str, Any] = {"key": key.key, "code": key.code, "windowsVirtualKeyCode": key.number}
            event |= {"modifiers": modifiers, "location": key.location, "isKeypad": key.location == 3}
            if kind == "down" and key.text and not modifiers & 7:
                event |= {"type": "keyDown", "text": key.text, "unmodifiedText": key.text}
            else:
                event["type"] = "rawKeyDown" if kind == "down" else "keyUp"
            self.keys_ms += 1
            event["timestamp"] = self.keys_ms / 1000
            numbers.append(self._send("Input.dispatchKeyEvent", **event))
        self._await(numbers)

    def press(self, key: Key, modifiers: int = 0, held: int = 0) -> None:
        """One key together with modifiers. `held`: modifiers that are down before and after it."""
        added = [NAMED[name] for name, bit in MODIFIERS.items() if modifiers & bit & ~held]
        self.keys(
            *(("down", each, modifiers | held) for each in added),
            ("down", key, modifiers | held),
            ("up", key, modifiers | held),
            *(("up", each, held) for each in reversed(added)),
        )

    def type(self, text: str) -> None:
        """Each character of a text, as from a keyboard."""
        events: list[tuple[Literal["down", "up"], Key, int]] = []
        for character in text.encode("utf-8", "replace").decode():
            key = typed(character)
            modifiers = SHIFT if key.shift else 0
            events += [("down", key, modifiers), ("up", key, modifiers)]
        self.keys(*events)

    def insert(self, text: str) -> None:
        """Puts a text into the focused field at once, without events of keys."""
        self.send("Input.insertText", text=text)

    def picture(self, *, width: int, height: int) -> bytes:
        """A PNG of the window's upper left part."""
        clip = {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}
        shot = self.send("Page.captureScreenshot", format="png", clip=clip, optimizeForSpeed=True)
        return base64.b64decode(shot["data"])

    def snapshot(self) -> dict[str, Any]:
        """The page's documents with their layout, as `DOMSnapshot.captureSnapshot` gives them, but for what differs
        each time (numbers of nodes and frames) and the texts of scripts and styles."""
        snapshot = self.send(
            "DOMSnapshot.captureSnapshot", computedStyles=[], includeDOMRects=True, includePaintOrder=True
        )
        strings, numbers = snapshot["strings"], itertools.count(1)
        for n, document in enumerate(snapshot["documents"]):
            strings[document["frameId"]] = str(n)
            nodes = document["nodes"]
            nodes["backendNodeId"] = list(itertools.islice(numbers, len(nodes["nodeType"])))
            for parent, value in zip(nodes["parentIndex"], nodes["nodeValue"], strict=True):
                if value >= 0 and parent >= 0 and strings[nodes["nodeName"][parent]] in _CODE:
                    strings[value] = ""
        return snapshot

    def release(self) -> None:
        """Lets go of keys and of the mouse's buttons."""
        self.keys(*(("up", key, 0) for key in tuple(self._down.values())))
        for button in [button for button, bit in _BITS.items() if self._buttons & bit]:
            self.point(*self.mouse_at, (RELEASE, 1), button=button, move=False)

    def rest(self) -> None:
        """Clicks where there is neither a task nor a scrollbar: the page keeps nothing of earlier places of mouse and
        keyboard."""
        assert self.opened is not None
        if not self._touched:
            return
        self.release()
        self.keys_ms += 2000
        self.run("__evopolicy.rest()")
        self.point(self.opened.width - _MARGIN, self.opened.height - _MARGIN, *CLICK, resting=True)
        self._touched = False

    def keep_small(self) -> None:
        """Between episodes: ends a browser that has grown too large."""
        self._episodes += 1
        due = self._browser is not None and self._episodes % _CHECK_EVERY == 0
        if due and self.browser.megabytes() > MAX_MB:
            self.lose()

    def lose(self) -> None:
        """Ends the browser; the next `open` starts another."""
        self.opened = None
        self._context = self._session = ""
        if self._browser is not None:
            browser, self._browser = self._browser, None
            browser.close()

    def _await(self, numbers: list[int]) -> None:
        for number in numbers:
            self.browser.devtools.result(number, CALL_S)

    def _send(self, method: str, *, wanted: bool = True, **params: Any) -> int:
        if not self._session:
            raise BrowserLostError("no page is open")
        return self.browser.devtools.send(method, self._session, wanted=wanted, **params)

    def _event(self, method: str, params: dict[str, Any], session: str) -> None:
        browser = self._browser
        if browser is None:
            return
        target = params.get("targetInfo", {})
        if method == "Fetch.requestPaused":
            self._serve(params, session)
        elif (method == "Target.attachedToTarget" and target["type"] != "page") or (
            method == "Target.targetCreated" and target.get("openerId")
        ):
            # Another frame's process, a worker, or another window: a page has none of them.
            browser.devtools.send("Target.closeTarget", wanted=False, targetId=target["targetId"])
        elif session != self._session:
            return
        elif method == "Page.loadEventFired":
            self._loaded = True
        elif method == "Inspector.targetCrashed":
            raise BrowserLostError("the page has crashed")
        elif method == "Page.javascriptDialogOpening":
            browser.devtools.send("Page.handleJavaScriptDialog", session, wanted=False, accept=False)

    def _serve(self, params: dict[str, Any], session: str) -> None:
        body = self._body(params["request"]["url"])
        answer: dict[str, Any]
        if body is None:
            method, answer = "Fetch.failRequest", {"errorReason": _NO_REASON}
        else:
            headers = {"Content-Type": body[0], "Cache-Control": "max-age=31536000, immutable"}
            listed = [{"name": name, "value": value} for name, value in headers.items()]
            method = "Fetch.fulfillRequest"
            answer = {"responseCode": 200, "responseHeaders": listed, "body": body[1]}
        self.browser.devtools.send(method, session, wanted=False, requestId=params["requestId"], **answer)

    def _body(self, url: str) -> tuple[str, str] | None:
        """Media type and base64 of the file that an address names; None for every other address."""
        if self.opened is None or not url.startswith(f"{ORIGIN}/"):
            return None
        name = url.removeprefix(f"{ORIGIN}/").partition("#")[0].partition("?")[0]
        root = self.opened.root
        try:
            file = (root / name).resolve()
            if file not in self._bodies and not (file.is_relative_to(root.resolve()) and file.is_file()):
                return None
        except (OSError, ValueError):  # too long a name, or none that a file can have
            return None
        if file not in self._bodies:
            kind = mimetypes.guess_type(file.name)[0] or "application/octet-stream"
            kind = f"{kind}; charset=utf-8" if kind.startswith("text/") else kind
            self._bodies[file] = kind, base64.b64encode(file.read_bytes()).decode()
        return self._bodies[file]


_CODE = ("SCRIPT", "STYLE")
_BITS: dict[Button, int] = {"left": 1, "right": 2, "middle": 4}


def _first(address: PageSource) -> list[tuple[str, dict[str, Any]]]:
    """Commands that prepare a target for a page."""
    size = {"width": address.width, "height": address.height, "deviceScaleFactor": 1, "mobile": False}
    commands: list[tuple[str, dict[str, Any]]] = [
        ("Inspector.enable", {}),
        ("Page.enable", {}),
        ("Fetch.enable", {"patterns": [{"urlPattern": "*"}]}),
        ("Target.setAutoAttach", {"autoAttach": True, "waitForDebuggerOnStart": True, "flatten": True}),
        ("Emulation.setFocusEmulationEnabled", {"enabled": True}),
        ("Emulation.setDeviceMetricsOverride", size),
    ]
    if address.accessible:
        # Keeps the accessibility tree between two questions: else each element's role and name builds it anew.
        commands.append(("Accessibility.enable", {}))
    return commands


def _script(seed: str, *, virtual: bool) -> str:
    text = files(__package__).joinpath("page.js").read_text("utf-8")
    return text.replace("SEED)", f"{json.dumps(seed)})").replace("VIRTUAL)", f"{json.dumps(virtual)})")


@cache
def shared() -> Page:
    return Page()
