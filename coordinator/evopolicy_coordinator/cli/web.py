"""`evopolicy web`: sweeps, runs and the cluster in a browser, live.

Exit codes: 0 ended by Ctrl-C or SIGTERM, 1 the machine refuses, 2 wrong usage.
"""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from pathlib import Path
from typing import Annotated

import typer

from evopolicy_common.cli.conventions import Connect, CredentialsFile, end_on_sigterm, setup_logging
from evopolicy_common.cli.frame import App
from evopolicy_common.errors import ConfigError, EvopolicyError, raised_as
from evopolicy_common.regular_files import read_given
from evopolicy_common.terminal import say
from evopolicy_common.wire import credentials, transport
from evopolicy_common.wire.credentials import Credentials
from evopolicy_common.wire.operator_client import OperatorClient

DEFAULT_PORT = 8765
_REACH_S = 5.0

app = App(name="web")


@app.command(name="web", epilog="Example: evopolicy web runs --credentials operator-me")
def web(
    runs: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Run directories, sweeps, or folders that contain them; default: runs.",
            show_default=False,
        ),
    ] = None,
    connect: Connect = None,
    file: CredentialsFile = None,
    http: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Address to listen on; port 0: a free port.")
    ] = f"127.0.0.1:{DEFAULT_PORT}",
    name: Annotated[
        list[str] | None,
        typer.Option(help="Additional host name for browsers; may be repeated.", show_default=False),
    ] = None,
    tls_certificate: Annotated[
        Path | None,
        typer.Option(help="PEM file with a certificate and its key: serve HTTPS.", show_default=False),
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(
            help="File (mode 0600) that keeps the token across restarts; default: a new token each time.",
            show_default=False,
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Folder of a report, for links to it.", show_default=False)
    ] = None,
) -> None:
    """Show sweeps, runs and the cluster in a browser, live.

    Prints an address with a token, which is needed on this machine too. Without --connect and --credentials it also
    shows this machine's coordinator, if one answers. Hidden scores of a run appear when no agent of a related run is
    alive.
    """
    setup_logging("warning")
    # Here, not above: it needs starlette and jinja2, and `evopolicy` loads this module to list its commands.
    from evopolicy_coordinator.web.access import Access, drawn_token, kept_token
    from evopolicy_coordinator.web.app import Site, listen, serve

    host, port = credentials.host_and_port(
        "--http", http, f"127.0.0.1:{DEFAULT_PORT}; port 0 takes a free one"
    )
    for path in (tls_certificate, report):
        if path is not None and not path.exists():
            raise ConfigError(f"{path} does not exist")
    if tls_certificate is not None:
        _check_certificate(tls_certificate)
    for folder in runs or ():
        if not folder.is_dir():
            problem = "is not a folder" if folder.exists() else "does not exist"
            raise ConfigError(f"{folder} {problem}; name a folder with runs")
    roots = runs or [folder for folder in (Path("runs"),) if folder.is_dir()]
    token = drawn_token() if token_file is None else kept_token(token_file)
    known = _credentials(tuple(connect or ()), file)
    with listen(host, port) as sock:
        if known is not None and not (connect or file) and not asyncio.run(_is_reachable(known)):
            say("this machine's coordinator does not answer: the folders alone are shown", err=True)
            known = None
        port = sock.getsockname()[1]
        shown = "127.0.0.1" if host in ("0.0.0.0", "::") else host
        scheme = "http" if tls_certificate is None else "https"
        base = f"{scheme}://{f'[{shown}]' if ':' in shown else shown}:{port}/login#token="
        site = Site(
            roots,
            Access(token, names=[host, *(name or ())], cookie=f"evopolicy_{port}"),
            credentials=known,
            report=report,
            title=", ".join(each.resolve().name or "/" for each in roots or [Path.cwd()]),
        )

        def ready() -> None:
            say(f"view: {base}{token}")
            if scheme == "http" and not credentials.stays_on_machine(f"tcp/{host}:{port}"):
                say(
                    "note: without --tls-certificate the token and the pages cross the network unencrypted",
                    err=True,
                )

        async def until_stopped() -> None:
            end_on_sigterm()
            with contextlib.suppress(asyncio.CancelledError):
                await serve(site, sock, ready, certificate=tls_certificate)

        asyncio.run(until_stopped())


def _check_certificate(certificate: Path) -> None:
    read_given(certificate, f"--tls-certificate {certificate}")
    remedy = "name a file with a certificate and its key, both in PEM (cat cert.pem key.pem)"
    with raised_as(ConfigError, f"--tls-certificate {certificate}", OSError, remedy=remedy):
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate)


async def _is_reachable(own: Credentials) -> bool:
    try:
        async with asyncio.timeout(_REACH_S), transport.connect(own) as link:
            await OperatorClient(link).status()
    except (EvopolicyError, TimeoutError):
        return False
    return True


def _credentials(connect: tuple[str, ...], file: Path | None) -> Credentials | None:
    """The operator's; None where none were named and this machine has none."""
    try:
        return credentials.find_running(connect, file)
    except ConfigError:
        if connect or file:
            raise
        return None
