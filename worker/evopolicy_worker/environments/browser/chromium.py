"""The browser's program and process: where it is found, how it is started, what it may use.

Rules:
- The process that starts it is an environment process in its jail; the browser is inside that jail too, where there is
  no network and no file of the machine's but installed programs. The browser's own sandbox is off: it needs namespaces,
  which the jail refuses.
- Its profile is a folder in the process's temporary folder, and is removed when the process ends. A killed process
  leaves it to the owner of that temporary folder: a slot, or `check-env`. Pages run in a browser context that keeps
  everything in memory.
- It ends with the process that started it: it ends when the debugging pipe closes.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import os
import resource
import shutil
import signal
import socket
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from evopolicy_common.errors import WorkerError
from evopolicy_common.processes import distribution, proc
from evopolicy_worker.environments.browser.devtools import DevTools
from evopolicy_worker.environments.interface.settings import BROWSER

_PROGRAMS = (
    "/usr/lib/chromium/chromium",
    "/usr/lib/chromium-browser/chromium-browser",
    "/usr/lib64/chromium-browser/chromium-browser",
    "/opt/google/chrome/chrome",
)
"""Programs themselves. What is on the path is often a script around one, which reads files that the jail hides."""
_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
MAX_JS_MB = 256
"""Heap of a page's scripts, MiB; a page that needs more crashes."""
MAX_MB = 600
"""A browser that has more than this resident after an episode, all its processes together, is started anew, MiB."""
_DATA_LIMIT = 4 << 30
"""Bytes of writable memory of each of its processes, which the kernel enforces."""
START_S = 60.0
"""How long a browser may take to answer first, seconds."""
REMEDY = "name the program of a Chromium that works in the variable EVOPOLICY_BROWSER"
_END_S = 10.0
"""How long its killed processes may take to end before the profile is removed all the same, seconds."""
_POLL_S = 0.005
_FOLDER = 5
"""The browser's descriptor of its profile."""

_DRAWING = """
    --disable-gpu --disable-software-rasterizer --in-process-gpu --disable-gpu-vsync --disable-frame-rate-limit
    --disable-lcd-text --disable-partial-raster --disable-smooth-scrolling --font-render-hinting=none
    --force-color-profile=srgb --force-device-scale-factor=1 --window-size=500,320
"""
"""On the processor, without waiting for a screen, the same pixels everywhere."""
_ALONE = """
    --force-webrtc-ip-handling-policy=disable_non_proxied_udp --disable-quic --block-new-web-contents
    --disable-background-networking --disable-background-timer-throttling --disable-backgrounding-occluded-windows
    --disable-renderer-backgrounding --disable-breakpad --disable-crash-reporter
    --disable-client-side-phishing-detection --disable-component-update
    --disable-component-extensions-with-background-pages --disable-default-apps --disable-domain-reliability
    --disable-extensions --disable-hang-monitor --disable-ipc-flooding-protection
    --disable-search-engine-choice-screen --disable-sync --metrics-recording-only --mute-audio
    --no-default-browser-check --no-first-run --no-pings --no-service-autorun --password-store=basic
    --use-mock-keychain
"""
"""No network, no other windows, nothing in the background."""
_FLAGS = (
    *("--headless", "--no-sandbox", "--no-zygote", "--remote-debugging-pipe"),
    *_DRAWING.split(),
    "--host-resolver-rules=MAP * ~NOTFOUND",
    *_ALONE.split(),
    # Memory: few processes, no cache.
    *("--disable-site-isolation-trials", "--renderer-process-limit=1", "--disk-cache-size=1"),
    "--media-cache-size=1",
    "--enable-blink-features=ComputedAccessibilityInfo",
    # DeferRendererTasksAfterInput: after a click or a key, scripts would wait for the next of 60 frames a second.
    (
        "--disable-features=AutofillServerCommunication,BackForwardCache,CertificateTransparencyComponentUpdater,"
        "DeferRendererTasksAfterInput,DialMediaRouteProvider,GlobalMediaControls,HttpsUpgrades,InterestFeedContentSuggestions,"
        "IsolateOrigins,MediaRouter,OptimizationHints,OverlayScrollbar,PaintHolding,Prerender2,RenderDocument,"
        "SpareRendererForSitePerProcess,Translate,site-per-process"
    ),
    "--enable-features=NetworkServiceInProcess2",
    f"--js-flags=--max-old-space-size={MAX_JS_MB} --random-seed=1 --hash-seed=1",
)


@cache
def program() -> str:
    """Path of the browser's program. Raises WorkerError with the requirement when there is none."""
    named = os.environ.get(BROWSER, "")
    if named:
        if os.access(named, os.X_OK) and not os.path.isdir(named):
            return os.path.abspath(named)
        raise WorkerError(f"Chromium, and {named!r} is no program: {REMEDY}")
    for path in (*_PROGRAMS, *filter(None, map(shutil.which, _NAMES))):
        if os.access(path, os.X_OK):
            return path
    raise WorkerError(f"Chromium: {distribution.install('chromium')}, or name one in EVOPOLICY_BROWSER")


def lacking() -> str:
    """The missing requirement for a browser, in words; empty when there is a browser."""
    try:
        program()
    except WorkerError as error:
        return str(error)
    return ""


class Chromium:
    """A running browser. `devtools` is the connection to it."""

    def __init__(self, on_event: Callable[[str, dict[str, Any], str], None]) -> None:
        """Raises WorkerError when there is no browser, and BrowserLostError when it does not start."""
        path = program()
        _check_sockets()
        self.profile = Path(tempfile.mkdtemp(prefix="browser-"))
        folder = _high(os.open(self.profile, os.O_PATH | os.O_DIRECTORY))
        theirs_in, ours_out = map(_high, os.pipe())
        ours_in, theirs_out = map(_high, os.pipe())
        self.devtools = DevTools(ours_out, ours_in, on_event)
        try:
            self.pid = self._spawn(path, theirs_in, theirs_out, folder)
        except OSError as error:
            self.devtools.close()
            shutil.rmtree(self.profile, ignore_errors=True)
            raise WorkerError(f"{path} cannot be started: {error.strerror}; {REMEDY}") from error
        finally:
            for descriptor in (theirs_in, theirs_out, folder):
                os.close(descriptor)
        self._owner = os.getpid()
        self._closed = False
        atexit.register(self.close)
        try:
            self.version = str(self.devtools.call("Browser.getVersion", timeout_s=START_S)["product"])
        except (WorkerError, KeyError) as error:
            stderr = (self.profile / "stderr").read_text(errors="replace").strip().splitlines()[-3:]
            self.close()
            why = error if isinstance(error, WorkerError) else "it does not tell its version"
            raise WorkerError(
                f"{path} does not start as a browser: {why}; its stderr: {' | '.join(stderr)[:500] or 'empty'};"
                f" {REMEDY}"
            ) from error

    def _spawn(self, path: str, theirs_in: int, theirs_out: int, folder: int) -> int:
        """Starts the program and returns its pid. OSError when it is none."""
        variables = {
            "PATH": "/usr/bin:/bin",
            "HOME": str(self.profile),
            # The profile too, by a path short enough for the socket that the browser makes in it.
            "TMPDIR": f"/proc/self/fd/{_FOLDER}",
            "XDG_CONFIG_HOME": f"{self.profile}/config",
            "XDG_CACHE_HOME": f"{self.profile}/cache",
            "LANG": "C.UTF-8",
            "TZ": "UTC",
        }
        soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
        limit = _DATA_LIMIT if hard == resource.RLIM_INFINITY else min(_DATA_LIMIT, hard)
        # Of this process, for its children; restored once the browser has started.
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
        try:
            return os.posix_spawn(
                path,
                [path, *_FLAGS, f"--user-data-dir={self.profile}", "about:blank"],
                variables,
                file_actions=[
                    (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0),
                    (os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0),
                    (os.POSIX_SPAWN_OPEN, 2, f"{self.profile}/stderr", os.O_WRONLY | os.O_CREAT, 0o600),
                    (os.POSIX_SPAWN_DUP2, theirs_in, 3),
                    (os.POSIX_SPAWN_DUP2, theirs_out, 4),
                    (os.POSIX_SPAWN_DUP2, folder, _FOLDER),
                ],
                setsid=True,
            )
        finally:
            resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))

    def megabytes(self) -> int:
        """Resident memory of all its processes together, MiB; what several processes share is divided among them."""
        return sum(proc.proportional_bytes(pid) or 0 for pid in _session(self.pid)) >> 20

    def close(self) -> None:
        """Ends all its processes and removes its profile. A second close, or one in a fork of its process, does
        nothing."""
        if self._closed or os.getpid() != self._owner:
            return
        self._closed = True
        atexit.unregister(self.close)
        # More than once: a process may start another meanwhile, and writes into the profile until it has ended.
        deadline = time.monotonic() + _END_S
        while (processes := _session(self.pid)) and time.monotonic() < deadline:
            for pid in processes:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            with contextlib.suppress(ChildProcessError):
                os.waitpid(self.pid, os.WNOHANG)
            time.sleep(_POLL_S)
        self.devtools.close()
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self.pid, 0)
        shutil.rmtree(self.profile, ignore_errors=True)


def _check_sockets() -> None:
    """WorkerError in a jail that refuses sockets: the browser makes one, though it reaches nothing by it."""
    try:
        socket.socket(socket.AF_UNIX).close()
    except PermissionError as error:
        raise WorkerError(
            "Chromium needs a local socket, which sandbox tier landlock refuses: web pages are played in tier bwrap;"
            " `evopolicy-worker doctor` tells how to get it"
        ) from error


def _high(descriptor: int) -> int:
    """The descriptor's file under another one, which is none of those that the browser gets."""
    moved = fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, _FOLDER + 1)
    os.close(descriptor)
    return moved


def _session(leader: int) -> list[int]:
    """Pids of the living processes of a session."""
    return [each.pid for each in proc.table() if each.session == leader and not each.dead]
