"""A headless Chromium over its debugging pipe: open a page, run scripts in it, see its console, take screenshots.

No driver and no web socket: the browser is started with `--remote-debugging-pipe`, and speaks the DevTools protocol in
JSON messages that end in a zero byte, on file descriptors 3 and 4.
"""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--disable-dev-shm-usage", "--hide-scrollbars", "--remote-debugging-pipe"),
)

KEYS = {
    "Tab": (9, ""),
    "Enter": (13, "\r"),
    "Space": (32, " "),
    "ArrowUp": (38, ""),
    "ArrowDown": (40, ""),
    "ArrowRight": (39, ""),
}
"""Key to its Windows key code, by which the protocol knows it, and the text that it types."""


def find_browser() -> str:
    """Path of a Chromium; FileNotFoundError saying what to install."""
    for name in NAMES:
        path = shutil.which(name)
        if path is not None:
            return path
    raise FileNotFoundError("the report's browser test needs Chromium: apt-get install chromium")


class Page:
    """One tab. `problems` has every console error, uncaught exception and failed request since it was opened."""

    def __init__(self, timeout_s: float = 60.0) -> None:
        self.problems: list[str] = []
        self.timeout_s = timeout_s
        self._profile = tempfile.mkdtemp(prefix="evopolicy-browser-")
        to_read, self._out = os.pipe()
        self._in, to_write = os.pipe()
        command = [find_browser(), *FLAGS, f"--user-data-dir={self._profile}", "about:blank"]
        shell = f'exec "$@" 3<&{to_read} 4>&{to_write}'
        self._process = subprocess.Popen(
            ["bash", "-c", shell, "bash", *command],
            pass_fds=(to_read, to_write),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        os.close(to_read)
        os.close(to_write)
        self._buffer = b""
        self._number = 0
        self._session: str | None = None
        self._loaded = False
        try:
            target = self.call("Target.createTarget", url="about:blank")["targetId"]
            self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
            for domain in ("Page", "Runtime", "Log", "Network"):
                self.call(f"{domain}.enable")
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the browser and removes its profile."""
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for descriptor in (self._in, self._out):
            os.close(descriptor)
        shutil.rmtree(self._profile, ignore_errors=True)

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """One command and its result; RuntimeError with the browser's message when it fails."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": params}
        if self._session is not None:
            message["sessionId"] = self._session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self._out, data) :]
        deadline = time.monotonic() + self.timeout_s
        while True:
            answer = self._next(deadline)
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return answer["result"]

    def _next(self, deadline: float) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            left = deadline - time.monotonic()
            ready = select.select([self._in], [], [], max(0.0, left))[0]
            if not ready:
                raise TimeoutError("the browser does not answer")
            data = os.read(self._in, 1 << 20)
            if not data:
                raise RuntimeError("the browser has gone")
            self._buffer += data
        line, _, self._buffer = self._buffer.partition(b"\0")
        message = json.loads(line)
        self._note(message)
        return message

    def _note(self, message: dict[str, Any]) -> None:
        params = message.get("params", {})
        match message.get("method"):
            case "Runtime.exceptionThrown":
                self.problems.append(
                    str(params["exceptionDetails"].get("exception", params["exceptionDetails"]))
                )
            case "Runtime.consoleAPICalled" if params["type"] in ("error", "warning", "assert"):
                self.problems.append(str([arg.get("value") for arg in params["args"]]))
            case "Log.entryAdded" if params["entry"]["level"] in ("error", "warning"):
                self.problems.append(params["entry"]["text"])
            case "Network.loadingFailed" if not params.get("canceled"):
                self.problems.append(f"not loaded: {params.get('errorText')}")
            case "Page.loadEventFired":
                self._loaded = True

    def open(self, path: Path) -> None:
        """Opens a file and waits for its load event."""
        self.visit(path.resolve().as_uri())

    def visit(self, url: str) -> None:
        """Opens an address and waits for its load event."""
        self._loaded = False
        self.call("Page.navigate", url=url)
        deadline = time.monotonic() + self.timeout_s
        while not self._loaded:
            self._next(deadline)

    def run(self, script: str) -> Any:
        """Value of a JavaScript expression, promises awaited; RuntimeError when it throws."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in result:
            raise RuntimeError(str(result["exceptionDetails"]["exception"].get("description")))
        return result["result"].get("value")

    def until(self, script: str) -> None:
        """Waits until a JavaScript expression is true; TimeoutError with the page's text when it does not become so."""
        deadline = time.monotonic() + self.timeout_s
        while not self.run(script):
            if time.monotonic() > deadline:
                raise TimeoutError(f"{script} is not true of: {self.run('document.body.innerText')}")
            time.sleep(0.1)

    def violations(self) -> list[str]:
        """Faults of the page's accessibility that axe-core finds: the rule and the elements of each."""
        axe = (Path(__file__).parent / "vendor" / "axe.min.js").read_text()
        self.run(f"(() => {{ {axe}; }})(), true")
        found = self.run("axe.run().then((result) => result.violations)")
        return [f"{one['id']}: {[node['html'] for node in one['nodes']]}" for one in found]

    def look(self, *, width: int = 1280, height: int = 800, dark: bool = False, phone: bool = False) -> None:
        """Sets the window's size in CSS pixels and the preferred colour scheme."""
        size = {"width": width, "height": height}
        self.call("Emulation.setDeviceMetricsOverride", **size, deviceScaleFactor=1, mobile=phone)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def press(self, key: str) -> None:
        """A key of the keyboard: `Tab`, `Enter`, `Space` or an arrow such as `ArrowDown`."""
        code, text = KEYS[key]
        name = " " if key == "Space" else key
        pressed: dict[str, Any] = {"key": name, "code": key, "windowsVirtualKeyCode": code}
        self.call("Input.dispatchKeyEvent", type="keyDown", **pressed, **({"text": text} if text else {}))
        self.call("Input.dispatchKeyEvent", type="keyUp", **pressed)

    def screenshot(self, path: Path) -> None:
        """PNG of the window."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))
