"""The web application: pages, their events, files, and acts. `serve` runs it until it is told to stop."""

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
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode

import msgspec
from prometheus_client import CollectorRegistry, Gauge, ProcessCollector, generate_latest
from starlette.applications import Starlette
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp

from evopolicy_common.errors import ConfigError, EvopolicyError
from evopolicy_common.logs import structlog
from evopolicy_common.messages.status import StatusReply
from evopolicy_common.wire.credentials import Credentials
from evopolicy_common.wire.http import bound, serving
from evopolicy_coordinator.server.monitoring.metrics import CONTENT_TYPE, StatusCollector
from evopolicy_coordinator.web import acting
from evopolicy_coordinator.web.access import Access, Guard
from evopolicy_coordinator.web.content import rendering
from evopolicy_coordinator.web.content.cluster import Cluster
from evopolicy_coordinator.web.content.confined import Confined, NotThereError
from evopolicy_coordinator.web.content.feeds import Feeds, View
from evopolicy_coordinator.web.content.run_detail import IMAGES, Detail
from evopolicy_coordinator.web.content.run_folders import Reader, RunFacts, Runs
from evopolicy_coordinator.web.content.tables import Words, ident
from evopolicy_coordinator.web.views.cluster import cluster_view
from evopolicy_coordinator.web.views.run import episode_values, run_view, submit_values
from evopolicy_coordinator.web.views.sweeps import sweeps_view

_FORM_WAIT_S = 10.0
_LOOK_S = 1.0
"""Minimum pause between two scans of the folders."""
_SHARE = 20.0
"""The pause is also at least this multiple of the last scan's duration."""
_CHUNK = 256 << 10
_MAX_Q = 200
_SANDBOXED = "default-src 'none'; sandbox"
"""Content security policy of files that agents and policies wrote: even when opened directly, they have none of our
pages' rights."""
_RANGE = re.compile(r"bytes=(\d{0,15})-(\d{0,15})")

log: structlog.stdlib.BoundLogger = structlog.get_logger()


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
        action_log: Path | None = None,
    ) -> None:
        """`credentials` None: no cluster, only folders. `action_log` None: no actions."""
        self.title = title
        self.access = access
        self.feeds = Feeds()
        self.reader = Reader(roots)
        self.runs = Runs(shut=None if credentials is not None else frozenset())
        self.report = None if report is None else Confined(report)
        self.book = None if action_log is None else acting.Log(action_log)
        self.cluster: Cluster | None = None
        self._moved = asyncio.Event()
        self._looked_at = float("-inf")
        self._looking = asyncio.Lock()
        self._took_s = 0.0
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        browsers = Gauge("evopolicy_web_browsers", "Browsers that follow a page.", registry=self._registry)
        browsers.set_function(lambda: self.feeds.watchers)
        if credentials is not None:
            self._registry.register(StatusCollector(self._known_status))
            self.cluster = Cluster(credentials, lambda: self.feeds.watchers > 0, self._moved.set)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Looks and tells inside the `async with`."""
        tasks = [asyncio.create_task(self._tell())]
        if self.cluster is not None:
            tasks.append(asyncio.create_task(self.cluster.run()))
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def refresh(self) -> None:
        """Reads the folders anew, unless that was just done."""
        if self.cluster is not None:
            self.cluster.wake()
        async with self._looking:
            if time.monotonic() - self._looked_at < max(_LOOK_S, _SHARE * self._took_s):
                return
            began = time.monotonic()
            known = self.cluster is None or self.cluster.is_known
            status = None if self.cluster is None else self.cluster.status
            open_runs = None if status is None else status.runs
            self.runs = await asyncio.to_thread(self.reader.read, open_runs, cluster_is_known=known)
            self._looked_at = time.monotonic()
            self._took_s = self._looked_at - began

    async def _tell(self) -> None:
        """Updates the open pages."""
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_LOOK_S):
                    await self._moved.wait()
            self._moved.clear()
            try:
                if self.feeds.watchers:
                    await self.refresh()
                for feed, view in self.feeds.watched():
                    feed.update(await asyncio.to_thread(view))
            except Exception:
                # Of one moment's files: the next look finds others.
                log.exception("a page could not be updated")
            await asyncio.sleep(0.5)

    def _known_status(self) -> StatusReply | None:
        return self.cluster.status if self.cluster is not None and self.cluster.is_known else None

    # ---- views by page ----

    def view_of(self, page: str, words: Words, *, may_act: bool) -> Callable[[], View] | None:
        """The function that makes the parts of a page; None for an unknown page."""
        if page == "runs":
            return lambda: sweeps_view(self.runs, self.cluster, words, self.reader.roots, acting=may_act)
        if page == "cluster" and self.cluster is not None:
            cluster = self.cluster
            return lambda: cluster_view(cluster, words, self.runs, self.reader.roots, acting=may_act)
        kind, _, key = page.partition("/")
        if kind == "run" and key in self.runs.by_key:
            return lambda: self._run_view(key, words, may_act)
        return None

    def _run_view(self, key: str, words: Words, may_act: bool) -> View:
        status = None if self.cluster is None else self.cluster.status
        run = self.runs.by_key[key]
        retries = () if self.cluster is None else tuple(self.cluster.retries.get(run.run, ()))
        return run_view(run, self.runs, self.reader, words, acting=may_act, status=status, retries=retries)

    # ---- answers ----

    def _shown(self, request: Request, here: str) -> dict[str, Any]:
        """The data that every page needs."""
        return {
            "here": here,
            "has_cluster": self.cluster is not None,
            "has_report": self.report is not None,
            "acting": request.scope.get("role") == "act" and self.book is not None,
        }

    async def live_page(self, request: Request, name: str, template: str, **values: Any) -> Response:
        """A page whose parts are kept up to date."""
        await self.refresh()
        words = _words(request)
        shown = self._shown(request, name)
        make = self.view_of(name, words, may_act=shown["acting"])
        if make is None:
            return self._message(request, "Not found", "There is no such page, or its run is gone.", 404)
        if name.startswith("run/"):
            values["run"] = self.runs.by_key[name.partition("/")[2]]
            values["title"] = f"{values['run'].entry} on {values['run'].env}"
        view = await asyncio.to_thread(make)
        feed = self.feeds.of(f"{shown['acting']} {name} {words}", make, view)
        query = {k: v for k, v in (("q", words.q), ("page", words.page), ("before", words.before)) if v}
        live = f"/events/{name}" + (f"?{urlencode(query)}" if query else "")
        values.setdefault("title", self.title)
        html = rendering.page(
            template, view=view, live=live, cursor=feed.cursor, words=words, **shown, **values
        )
        return HTMLResponse(html)

    async def home(self, request: Request) -> Response:
        return await self.live_page(request, "runs", "runs.html.j2")

    async def cluster_page(self, request: Request) -> Response:
        title = (
            "Cluster"
            if self.cluster is None or self.cluster.status is None
            else f"Cluster {self.cluster.status.cluster}"
        )
        return await self.live_page(request, "cluster", "cluster.html.j2", title=title)

    async def run_page(self, request: Request) -> Response:
        return await self.live_page(
            request, f"run/{request.path_params['key']}", "run.html.j2", replays=self._replays(request)
        )

    def _replays(self, request: Request) -> list[tuple[str, str]]:
        """Recordings of hidden episodes, where they may be shown: their names and addresses."""
        run = self.runs.by_key.get(request.path_params["key"])
        if run is None or run.path is None or not self.runs.may_show(run):
            return []
        return [(name, _file_link(run, f"replays/{name}/video.mp4")) for name in Detail(run.path).replays()]

    async def events(self, request: Request) -> Response:
        """The updates of one page, as server-sent events."""
        name, words = request.path_params["page"], _words(request)
        may_act = self._shown(request, name)["acting"]
        make = self.view_of(name, words, may_act=may_act)
        if make is None:
            return PlainTextResponse("There is no such page.\n", 404)
        cursor = request.headers.get("last-event-id") or request.query_params.get("since", "")
        feed = self.feeds.of(f"{may_act} {name} {words}", make)
        if feed.version == 0 or not feed.watchers:
            feed.update(await asyncio.to_thread(make))
        headers = {"x-accel-buffering": "no"}
        return StreamingResponse(feed.events(cursor[:64]), media_type="text/event-stream", headers=headers)

    async def submit_page(self, request: Request) -> Response:
        await self.refresh()
        run = self.runs.by_key.get(request.path_params["key"])
        index = request.path_params["index"]
        values = None
        if run is not None:
            values = await asyncio.to_thread(submit_values, run, self.reader, index)
        if run is None or values is None:
            return self._message(
                request, "Not found", "There is no such submit, or it has no verdict yet.", 404
            )
        html = rendering.page(
            "submit.html.j2",
            title=f"Submit {index} of {run.entry}",
            run=run,
            **values,
            **self._shown(request, "submit"),
        )
        return HTMLResponse(html)

    async def episode_page(self, request: Request) -> Response:
        await self.refresh()
        run = self.runs.by_key.get(request.path_params["key"])
        index, episode = request.path_params["index"], request.path_params["episode"]
        try:
            if run is None or run.path is None:
                raise NotThereError("run")
            values = await asyncio.to_thread(_episode, run, run.path, index, episode)
        except NotThereError:
            return self._message(request, "Not found", "There is no such episode here.", 404)
        html = rendering.page(
            "episode.html.j2", title=f"Episode {episode} of submit {index}", run=run, index=index, episode=episode,
            **values, **self._shown(request, "episode"),
        )  # fmt: skip
        return HTMLResponse(html)

    async def file(self, request: Request) -> Response:
        """A file of a run's feedback, or a recording of it once hidden results may be shown."""
        run = self.runs.by_key.get(request.path_params["key"])
        path = request.query_params.get("path", "")
        allowed = path.startswith("workspace/feedback/")
        if run is not None and path.startswith("replays/"):
            await self.refresh()
            run = self.runs.by_key.get(run.key)
            allowed = run is not None and self.runs.may_show(run)
        if run is None or run.path is None or not allowed:
            return PlainTextResponse("There is no such file.\n", 404)
        suffix = os.path.splitext(path)[1].lower()
        types = {**IMAGES, ".mp4": "video/mp4"}
        try:
            return _file(
                request, Confined(run.path), path, types.get(suffix, "text/plain; charset=utf-8"), _SANDBOXED
            )
        except NotThereError:
            return PlainTextResponse("There is no such file.\n", 404)

    async def report_file(self, request: Request) -> Response:
        """A file of a written report, which holds hidden scores of all its runs."""
        await self.refresh()
        if self.report is None:
            return self._message(
                request, "No report", "Start the view with --report DIR to have one here.", 404
            )
        if self.runs.shut is None or self.runs.shut:
            text = "The report holds hidden scores. It is shown once no agent is alive."
            return self._message(request, "Not yet", text, 403)
        path = request.path_params["path"]
        types = {
            ".html": "text/html; charset=utf-8",
            ".svg": "image/svg+xml",
            ".csv": "text/csv",
            ".mp4": "video/mp4",
            **IMAGES,
        }
        try:
            kind = types.get(os.path.splitext(path)[1].lower(), "text/plain; charset=utf-8")
            return _file(request, self.report, path, kind, report_policy())
        except NotThereError:
            return self._message(request, "Not found", "The report has no such page.", 404)

    # ---- signing in ----

    async def login(self, request: Request) -> Response:
        if request.method == "GET":
            return HTMLResponse(rendering.page("login.html.j2", title="Sign in", wrong=False))
        body = await _form(request)
        role = self.access.role_of_token(body.get("token", ""))
        if role is None:
            return HTMLResponse(rendering.page("login.html.j2", title="Sign in", wrong=True), 401)
        answer = RedirectResponse("/", 303)
        answer.set_cookie(
            self.access.cookie,
            self.access.cookie_of(role),
            httponly=True,
            samesite="strict",
            secure=request.url.scheme == "https",
            path="/",
        )
        return answer

    async def static(self, request: Request) -> Response:
        file = rendering.static_files().get(request.path_params["name"])
        if file is None:
            return PlainTextResponse("There is no such file.\n", 404)
        return Response(file[0], media_type=file[1], headers={"cache-control": "max-age=300"})

    async def health(self, request: Request) -> Response:
        """For service managers: the process serves. It tells nothing else, as it needs no token."""
        return PlainTextResponse("ok\n")

    async def metrics(self, request: Request) -> Response:
        """The coordinator's last metrics, and those of this process, in Prometheus' text format."""
        if self.cluster is not None:
            self.cluster.wake()
        return Response(await asyncio.to_thread(generate_latest, self._registry), media_type=CONTENT_TYPE)

    # ---- acting ----

    async def act(self, request: Request) -> Response:
        """GET describes the action and shows a button. POST carries it out."""
        kind, name, verb = (request.path_params[each] for each in ("kind", "name", "verb"))
        act = acting.ACTS.get((kind, verb))
        shown = self._shown(request, "act")
        if not shown["acting"] or self.book is None:
            return self._message(
                request,
                "Not allowed",
                "This needs the acting token of a view that was started with --act.",
                403,
            )
        if act is None:
            return self._message(request, "Not found", "There is no such action.", 404)
        back = {"worker": "/cluster", "run": "/", "sweep": "/"}[kind]
        sweep = next((each for each in self.runs.sweeps if ident("sweep", str(each.root)) == name), None)
        label = sweep.name if kind == "sweep" and sweep is not None else name
        if request.method == "GET":
            fingerprint_class = request.query_params.get("class", "")[:200]
            html = rendering.page(
                "act.html.j2",
                title=f"{act.title}: {label}",
                act=act,
                label=label,
                fingerprint_class=fingerprint_class,
                back=back,
                verb=verb,
                **shown,
            )
            return HTMLResponse(html)
        body = await _form(request)
        form = {each: body.get(each, "")[:500] for each in ("class", "reason") if body.get(each)}
        if act.needs and not (form.get("reason") and form.get("class")):
            return self._message(
                request, "Not done", "A class and a reason are needed; the run's record names both.", 400
            )
        operator = None if self.cluster is None else self.cluster.operator
        client = request.client
        who = "browser" if client is None else f"browser at {client.host}"
        try:
            await acting.logged(
                self.book, who, kind, label, verb,
                lambda: acting.carry_out(operator, kind, name, verb, sweep, form), **form,
            )  # fmt: skip
        except (EvopolicyError, OSError) as error:
            return self._message(request, "Not done", str(error), 409)
        self._looked_at = float("-inf")
        if self.cluster is not None:
            self.cluster.acted()
        return RedirectResponse(back, 303)

    async def action_log(self, request: Request) -> Response:
        shown = self._shown(request, "log")
        if not shown["acting"] or self.book is None:
            return self._message(request, "Not allowed", "This needs the acting token.", 403)
        entries = await asyncio.to_thread(self.book.last)
        return HTMLResponse(rendering.page("log.html.j2", title="Actions", entries=entries, **shown))

    def _message(self, request: Request, title: str, text: str, status: int) -> Response:
        html = rendering.page("message.html.j2", title=title, text=text, back="/", **self._shown(request, ""))
        return HTMLResponse(html, status)

    def app(self) -> ASGIApp:
        """The application with its guards."""
        routes = [
            Route("/", self.home),
            Route("/cluster", self.cluster_page),
            Route("/run/{key}", self.run_page),
            Route("/run/{key}/submit/{index:int}", self.submit_page),
            Route("/run/{key}/submit/{index:int}/episode/{episode:int}", self.episode_page),
            Route("/run/{key}/file", self.file),
            Route("/events/{page:path}", self.events),
            Route("/report/{path:path}", self.report_file),
            Route("/login", self.login, methods=["GET", "POST"]),
            Route("/static/{name}", self.static),
            Route("/healthz", self.health),
            Route("/metrics", self.metrics),
            Route("/act/{kind}/{name}/{verb}", self.act, methods=["GET", "POST"]),
            Route("/log", self.action_log),
        ]
        site = Starlette(routes=routes, exception_handlers={Exception: _failed})
        return Guard(GZipMiddleware(site, minimum_size=1000), self.access)


async def _failed(request: Request, error: Exception) -> Response:
    log.error("request failed", path=request.url.path[:200], exc_info=error)
    return PlainTextResponse("The view failed at this page. Its log tells why.\n", 500)


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


def _file_link(run: RunFacts, path: str) -> str:
    return f"/run/{run.key}/file?{urlencode({'path': path})}"


def _episode(run: RunFacts, folder: Path, index: int, episode: int) -> dict[str, Any]:
    detail = Detail(folder)
    place, names = detail.episode_files(index, episode)
    beside = detail.episodes(index)
    try:
        played = detail.played(place)
    except NotThereError:
        played = None
    texts = [
        (name, text)
        for name in ("error.txt", "stdout.txt", "stderr.txt")
        if name in names and (text := detail.text(f"{place}/{name}"))
    ]
    images = [
        (name, _file_link(run, f"{place}/{name}"))
        for name in names
        if os.path.splitext(name)[1].lower() in IMAGES
    ]
    videos = [_file_link(run, f"{place}/{name}") for name in names if name.endswith(".mp4")]
    near = {
        "previous": episode - 1 if episode - 1 in beside else None,
        "next": episode + 1 if episode + 1 in beside else None,
    }
    return {**episode_values(played), **near, "texts": texts, "images": images, "videos": videos}


def _file(request: Request, files: Confined, path: str, kind: str, policy: str) -> Response:
    """A file, or the requested range of it. Raises NotThereError if it does not exist."""
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
        status = 206
        headers["content-range"] = f"bytes {first}-{last}/{size}"
    headers["content-length"] = str(last - first + 1)
    return StreamingResponse(_chunks(fd, first, last), status, headers, media_type=kind)


async def _chunks(fd: int, first: int, last: int) -> AsyncIterator[bytes]:
    with os.fdopen(fd, "rb") as file:
        file.seek(first)
        remaining = last - first + 1
        while remaining > 0:
            data = await asyncio.to_thread(file.read, min(_CHUNK, remaining))
            if not data:
                return
            remaining -= len(data)
            yield data


class Address(msgspec.Struct, frozen=True, kw_only=True):
    """The address of the listener."""

    host: str
    port: int
    certificate: Path | None = None
    private_key: Path | None = None


def listen(address: Address) -> socket.socket:
    """A bound socket. ConfigError where the machine refuses."""
    try:
        return bound(address.host, address.port)
    except OSError as error:
        raise ConfigError(
            f"cannot listen on {address.host}:{address.port}: {error.strerror or error}; choose another with --http"
            " HOST:PORT"
        ) from error


async def serve(site: Site, sock: socket.socket, address: Address, ready: Callable[[], None]) -> None:
    """Serves until the task is cancelled."""
    # A connection that never ends its TLS handshake holds a descriptor for a minute.
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    tls = {"certificate": address.certificate, "private_key": address.private_key}
    async with site.running(), serving(site.app(), sock, **tls) as task:
        ready()
        await asyncio.shield(task)
