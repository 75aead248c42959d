"""The web application: pages and files. `serve` runs it until it is told to stop.

An open page asks for itself every two seconds, with the `ETag` of what it has, and replaces the parts that changed.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import os
import re
import resource
import socket
import time
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from starlette.applications import Starlette
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp

from evopolicy_common.errors import ConfigError
from evopolicy_common.logs import log
from evopolicy_common.messages.status import StatusReply
from evopolicy_common.regular_files import Confined, NotThereError
from evopolicy_common.wire.credentials import Credentials
from evopolicy_common.wire.http import bound, serving
from evopolicy_coordinator.web.access import Access, RequestGuard
from evopolicy_coordinator.web.content import rendering
from evopolicy_coordinator.web.content.cluster import ShownCluster
from evopolicy_coordinator.web.content.metrics import CONTENT_TYPE, StatusCollector
from evopolicy_coordinator.web.content.rendering import Words
from evopolicy_coordinator.web.content.run_detail import IMAGES, Detail
from evopolicy_coordinator.web.content.run_folders import FolderReader, RunFacts, ShownRuns
from evopolicy_coordinator.web.views.cluster import cluster_view
from evopolicy_coordinator.web.views.run import episode_values, file_link, live_run_view, submit_values
from evopolicy_coordinator.web.views.sweeps import sweeps_view
from evopolicy_results.html import PageView

_FORM_WAIT_S = 10.0
_SCAN_S = 1.0
"""Minimum pause between two scans of the folders."""
_SHARE = 20.0
"""The pause is also at least this multiple of the last scan's duration."""
_CHUNK = 256 << 10
_MAX_Q = 200
_SANDBOXED = "default-src 'none'; sandbox"
"""Content security policy of files that agents and policies wrote: even when opened directly, they have none of our
pages' rights."""
_RANGE = re.compile(r"bytes=(\d{0,15})-(\d{0,15})")

_REPORT_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".svg": "image/svg+xml",
    ".csv": "text/csv",
    ".mp4": "video/mp4",
    **IMAGES,
}
_NOT_THERE = 404, "Not found", "Nothing is at this address, or its run is gone."


class PageError(Exception):
    """A request that is answered with a status, a title and a text."""


class Site:
    """The data behind the pages, kept up to date."""

    def __init__(
        self,
        roots: list[Path],
        access: Access,
        *,
        title: str = "evopolicy",
        credentials: Credentials | None = None,
        report: Path | None = None,
    ) -> None:
        """`credentials` None: no cluster, only folders."""
        self.title = title
        self.access = access
        self.reader = FolderReader(roots)
        self.runs = ShownRuns(shut=None if credentials is not None else frozenset())
        self.report = None if report is None else Confined(report)
        self.cluster: ShownCluster | None = None
        self._scanned_at = float("-inf")
        self._scanning = asyncio.Lock()
        self._scan_s = 0.0
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        if credentials is not None:
            cluster = self.cluster = ShownCluster(credentials)
            self._registry.register(StatusCollector(lambda: cluster.status if cluster.is_known else None))

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Keeps the cluster's status up to date inside the `async with`."""
        tasks = [] if self.cluster is None else [asyncio.create_task(self.cluster.run())]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    @property
    def status(self) -> StatusReply | None:
        return None if self.cluster is None else self.cluster.status

    async def refresh(self) -> None:
        """Reads the folders anew, unless that was just done."""
        if self.cluster is not None:
            self.cluster.wake()
        async with self._scanning:
            began = time.monotonic()
            if began - self._scanned_at < max(_SCAN_S, _SHARE * self._scan_s):
                return
            known = self.cluster is None or self.cluster.is_known
            open_runs = () if self.status is None else self.status.runs
            self.runs = await asyncio.to_thread(self.reader.read_runs, open_runs, cluster_is_known=known)
            self._scanned_at = time.monotonic()
            self._scan_s = self._scanned_at - began

    # ---- views by page ----

    def view_of(self, page: str, words: Words) -> Callable[[], PageView]:
        """The function that makes the parts of a page. NotThereError for an unknown page."""
        cluster = self.cluster
        if page == "runs":
            return lambda: sweeps_view(self.runs, cluster, words, self.reader.roots)
        if page == "cluster" and cluster is not None:
            return lambda: cluster_view(cluster, words, self.runs, self.reader.roots)
        kind, _, key = page.partition("/")
        if kind != "run" or key not in self.runs.by_key:
            raise NotThereError(page)

        def view() -> PageView:
            run = self.runs.by_key[key]
            retries = () if cluster is None else tuple(cluster.retries.get(run.run, ()))
            return live_run_view(run, self.runs, self.reader, words, retries=retries)

        return view

    # ---- answers ----

    def _page(
        self, request: Request, template: str, status: int = 200, *, here: str = "", **values: Any
    ) -> HTMLResponse:
        html = rendering.page(
            template,
            here=here,
            has_cluster=self.cluster is not None,
            has_report=self.report is not None,
            **values,
        )
        return HTMLResponse(html, status)

    def _run(self, request: Request) -> RunFacts:
        run = self.runs.by_key.get(request.path_params["key"])
        if run is None:
            raise NotThereError(request.path_params["key"])
        return run

    async def live_page(
        self, request: Request, name: str, template: str, title: str, **more: Any
    ) -> Response:
        """A page whose parts are kept up to date; status 304 for a browser that has it."""
        words = _words(request)
        view = await asyncio.to_thread(self.view_of(name, words))
        answer = self._page(request, template, here=name, title=title, view=view, words=words, **more)
        etag = f'"{hashlib.sha256(answer.body).hexdigest()}"'
        if request.headers.get("if-none-match") == etag:
            return Response(status_code=304, headers={"etag": etag})
        answer.headers["etag"] = etag
        return answer

    async def home(self, request: Request) -> Response:
        await self.refresh()
        return await self.live_page(request, "runs", "runs", self.title)

    async def cluster_page(self, request: Request) -> Response:
        await self.refresh()
        title = "Cluster" if self.status is None else f"Cluster {self.status.cluster}"
        return await self.live_page(request, "cluster", "cluster", title)

    async def run_page(self, request: Request) -> Response:
        await self.refresh()
        run, replays = self._run(request), []
        if run.path is not None and self.runs.may_show(run):  # recordings of hidden episodes
            names = Detail(run.path).replays()
            replays = [(name, file_link(run, f"replays/{name}/video.mp4")) for name in names]
        title = f"{run.entry} on {run.env}"
        lead = [f"Run {run.exp_id}", f"repeat {run.repeat}", *filter(None, (run.run, str(run.path or "")))]
        name = f"run/{run.key}"
        return await self.live_page(request, name, "run", title, lead=lead, replays=replays, back="/")

    async def submit_page(self, request: Request) -> Response:
        await self.refresh()
        run, index = self._run(request), request.path_params["index"]
        values = await asyncio.to_thread(submit_values, run, self.reader, index)
        title = f"Submit {index} of {run.entry}"
        return self._page(request, "submit", title=title, run=run, **values)

    async def episode_page(self, request: Request) -> Response:
        await self.refresh()
        run, index, episode = self._run(request), request.path_params["index"], request.path_params["episode"]
        values = await asyncio.to_thread(episode_values, run, index, episode)
        title = f"Episode {episode} of submit {index}"
        return self._page(request, "episode", title=title, run=run, index=index, episode=episode, **values)

    async def file(self, request: Request) -> Response:
        """A file of a run's feedback, or a recording of it once hidden results may be shown."""
        path, run = request.query_params.get("path", ""), self._run(request)
        allowed = path.startswith("workspace/feedback/")
        if path.startswith("replays/"):
            await self.refresh()
            run = self._run(request)
            allowed = self.runs.may_show(run)
        if run.path is None or not allowed:
            raise NotThereError(path)
        return _file(request, Confined(run.path), path, {**IMAGES, ".mp4": "video/mp4"}, _SANDBOXED)

    async def report_file(self, request: Request) -> Response:
        """A file of a written report, which holds hidden scores of all its runs."""
        await self.refresh()
        if self.report is None:
            raise PageError(404, "No report", "Start the view with --report DIR to have one here.")
        if self.runs.shut is None or self.runs.shut:
            text = "The report holds hidden scores. It is shown once no agent is alive."
            raise PageError(403, "Not yet", text)
        return _file(request, self.report, request.path_params["path"], _REPORT_TYPES, report_policy())

    # ---- signing in ----

    async def login(self, request: Request) -> Response:
        if request.method == "GET":
            return self._page(request, "login", title="Sign in", wrong=False)
        if not self.access.admits_token((await _form(request)).get("token", "")):
            return self._page(request, "login", 401, title="Sign in", wrong=True)
        answer = RedirectResponse("/", 303)
        cookie, secure = self.access.cookie_value, request.url.scheme == "https"
        answer.set_cookie(self.access.cookie, cookie, httponly=True, samesite="strict", secure=secure)
        return answer

    async def static(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in rendering.static_files():
            raise NotThereError(name)
        data, kind = rendering.static_files()[name]
        return Response(data, media_type=kind, headers={"cache-control": "max-age=300"})

    async def health(self, request: Request) -> Response:
        """For service managers: the process serves. It tells nothing else, as it needs no token."""
        return PlainTextResponse("ok\n")

    async def metrics(self, request: Request) -> Response:
        """The cluster's last status, and figures of this process, in Prometheus' text format."""
        if self.cluster is not None:
            self.cluster.wake()
        return Response(await asyncio.to_thread(generate_latest, self._registry), media_type=CONTENT_TYPE)

    async def _refused(self, request: Request, error: Exception) -> Response:
        status, title, text = error.args if isinstance(error, PageError) else _NOT_THERE
        return self._page(request, "message", status, title=title, text=text, back="/")

    def app(self) -> ASGIApp:
        routes = [
            Route("/", self.home),
            Route("/cluster", self.cluster_page),
            Route("/run/{key}", self.run_page),
            Route("/run/{key}/submit/{index:int}", self.submit_page),
            Route("/run/{key}/submit/{index:int}/episode/{episode:int}", self.episode_page),
            Route("/run/{key}/file", self.file),
            Route("/report/{path:path}", self.report_file),
            Route("/login", self.login, methods=["GET", "POST"]),
            Route("/static/{name}", self.static),
            Route("/healthz", self.health),
            Route("/metrics", self.metrics),
        ]
        refused = {PageError: self._refused, NotThereError: self._refused}
        site = Starlette(routes=routes, exception_handlers={Exception: _failed, **refused})
        return RequestGuard(GZipMiddleware(site, minimum_size=1000), self.access)


async def _failed(request: Request, error: Exception) -> Response:
    log.error("request failed", path=request.url.path[:200], exc_info=error)
    return PlainTextResponse("The view failed at this page. Its log has the reason.\n", 500)


def report_policy() -> str:
    """Content security policy of a report's pages, which contain their style and our single script."""
    script = b"\n" + rendering.static_files()["report.js"][0]
    digest = base64.b64encode(hashlib.sha256(script).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src 'self' data:; media-src"
        " 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def _words(request: Request) -> Words:
    query = request.query_params

    def whole(name: str) -> int | None:
        text = query.get(name, "")
        return int(text) if text.isdecimal() and len(text) < 15 else None

    return Words(q=query.get("q", "")[:_MAX_Q], page=whole("page") or 0, before=whole("before"))


async def _form(request: Request) -> dict[str, str]:
    """The fields of a small form; none for one that is too long or too late."""
    data = b""
    try:
        async with asyncio.timeout(_FORM_WAIT_S):
            async for chunk in request.stream():
                data += chunk
                if len(data) > 16_384:
                    return {}
    except TimeoutError:
        return {}
    return dict(parse_qsl(data.decode("utf-8", "replace")))


def _file(request: Request, files: Confined, path: str, types: Mapping[str, str], policy: str) -> Response:
    """A file, or the requested range of it; plain text unless its suffix tells. Raises NotThereError."""
    fd = files.open(path)
    size = os.fstat(fd).st_size
    first, last, status = 0, size - 1, 200
    headers = {"accept-ranges": "bytes", "content-security-policy": policy}
    if (match := _RANGE.fullmatch(request.headers.get("range", ""))) and size:
        start, end = match.groups()
        if start:
            first, last = int(start), min(size - 1, int(end) if end else size - 1)
        elif end:
            first = max(0, size - int(end))
        if first > last:
            os.close(fd)
            return Response(status_code=416, headers={"content-range": f"bytes */{size}"})
        status, headers["content-range"] = 206, f"bytes {first}-{last}/{size}"
    headers["content-length"] = str(last - first + 1)
    kind = types.get(Path(path).suffix.lower(), "text/plain; charset=utf-8")
    return StreamingResponse(_chunks(fd, first, last), status, headers, media_type=kind)


async def _chunks(fd: int, first: int, last: int) -> AsyncIterator[bytes]:
    with os.fdopen(fd, "rb") as file:
        file.seek(first)
        while data := await asyncio.to_thread(file.read, min(_CHUNK, last + 1 - file.tell())):
            yield data


def listen(host: str, port: int) -> socket.socket:
    """A bound socket. ConfigError where the machine refuses."""
    try:
        return bound(host, port)
    except OSError as error:
        text = (
            f"cannot listen on {host}:{port}: {error.strerror or error}; choose another with --http HOST:PORT"
        )
        raise ConfigError(text) from error


async def serve(
    site: Site, sock: socket.socket, ready: Callable[[], None], *, certificate: Path | None = None
) -> None:
    """Serves until the task is cancelled. `certificate`: as for `serving`."""
    # A connection that never ends its TLS handshake holds a descriptor for a minute.
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    async with site.running(), serving(site.app(), sock, certificate=certificate) as task:
        ready()
        await asyncio.shield(task)
