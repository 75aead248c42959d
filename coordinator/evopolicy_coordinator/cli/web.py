"""`evopolicy web`: sweeps, runs and the cluster in a browser, live.

Exit codes: 0 ended by Ctrl-C or SIGTERM, 1 the machine refuses, 2 wrong usage.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evopolicy_common.cli.conventions import (
    Connect,
    CredentialsFile,
    end_on_sigterm,
    fail_on_our_errors,
    setup_logging,
)
from evopolicy_common.cli.frame import App
from evopolicy_common.errors import ConfigError, EvopolicyError
from evopolicy_common.processes.preflight import check_writable
from evopolicy_common.records.blobs import announcing
from evopolicy_common.regular_files import read_given
from evopolicy_common.terminal import say
from evopolicy_common.wire import credentials, transport
from evopolicy_common.wire.credentials import Credentials
from evopolicy_common.wire.operator_client import OperatorClient

if TYPE_CHECKING:
    from evopolicy_coordinator.web.access import Tokens
    from evopolicy_coordinator.web.app import Address

DEFAULT_PORT = 8765
_REACH_S = 5.0

app = App(name="web")


@app.command(name="web", epilog="Example: evopolicy web runs --credentials operator-me")
def web(
    runs: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Run directories, folders of sweeps, or folders that contain them; default: runs.",
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
        typer.Option(
            help="Additional host name for browsers; may be repeated.",
            show_default=False,
        ),
    ] = None,
    tls_certificate: Annotated[
        Path | None, typer.Option(help="PEM file: serve HTTPS with this certificate.", show_default=False)
    ] = None,
    tls_key: Annotated[
        Path | None, typer.Option(help="PEM file with its private key.", show_default=False)
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(
            help=(
                "File that keeps the tokens, mode 0600, so that browsers stay signed in after a restart; default: new"
                " tokens."
            ),
            show_default=False,
        ),
    ] = None,
    act: Annotated[
        bool,
        typer.Option(
            "--act",
            help="Print a second address that also allows to pause, cancel and repin; every action is logged.",
        ),
    ] = False,
    action_log: Annotated[
        Path | None,
        typer.Option(
            help="Log of these actions; default: web-actions.jsonl in the user's state home.",
            show_default=False,
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(help="Folder of a report, for links to it.", show_default=False),
    ] = None,
    url_file: Annotated[
        Path | None, typer.Option(hidden=True, help="Write the address here, mode 0600.")
    ] = None,
) -> None:
    """Show sweeps, runs and the cluster in a browser, live.

    Prints an address with a token, which is needed on this machine too. Without --connect and --credentials it asks
    this machine's own coordinator, if one answers, and else shows the folders alone. Hidden scores of a run appear when
    no agent of a related run is alive.
    """
    with fail_on_our_errors():
        setup_logging("warning")
        # Here, not above: it needs starlette and jinja2, and `evopolicy` loads this module to list its commands.
        from evopolicy_coordinator.web.access import Tokens, kept_tokens
        from evopolicy_coordinator.web.app import Address

        host, port = _address(http)
        if (tls_certificate is None) != (tls_key is None):
            raise ConfigError("give --tls-certificate and --tls-key together")
        address = Address(host=host, port=port, certificate=tls_certificate, private_key=tls_key)
        for path in (tls_certificate, tls_key, report):
            if path is not None and not path.exists():
                raise ConfigError(f"{path} does not exist")
        if tls_certificate is not None and tls_key is not None:
            _check_certificate(tls_certificate, tls_key)
        roots = _roots(runs)
        tokens = Tokens.drawn() if token_file is None else kept_tokens(token_file)
        names = [host, *(name or ())]
        given = _credentials(tuple(connect or ()), file)
        book = (action_log or credentials.state_home() / "web-actions.jsonl") if act else None
        if book is not None:
            check_writable(book.parent, "--action-log")
        with announcing(url_file) as announce:
            asyncio.run(
                _serve(address, roots, tokens, names, given, bool(connect or file), report, book, announce)
            )


def _check_certificate(certificate: Path, key: Path) -> None:
    for option, path in (("--tls-certificate", certificate), ("--tls-key", key)):
        read_given(path, f"{option} {path}")
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key)
    except OSError as error:
        raise ConfigError(
            f"--tls-certificate {certificate} with --tls-key {key}: {error.strerror or error}; name a certificate and"
            " its key, both in PEM"
        ) from error


async def _serve(
    address: Address,
    roots: list[Path],
    tokens: Tokens,
    names: list[str],
    found: Credentials | None,
    named: bool,
    report: Path | None,
    book: Path | None,
    announce: Callable[[bytes], None],
) -> None:
    """`named`: the cluster was named; without it nothing hidden is shown."""
    from evopolicy_coordinator.web.access import Access
    from evopolicy_coordinator.web.app import Site, listen, serve

    end_on_sigterm()
    if found is not None and not named and not await _is_reachable(found):
        say("this machine's coordinator does not answer: the folders alone are shown", err=True)
        found = None
    with listen(address) as sock:
        port = sock.getsockname()[1]
        site = Site(
            roots,
            Access(tokens, acting=book is not None, names=names, cookie=f"evopolicy_{port}"),
            credentials=found,
            report=report,
            action_log=book,
            title=", ".join(root.name or str(root) for root in site_roots(roots)),
        )
        shown = "127.0.0.1" if address.host in ("0.0.0.0", "::") else address.host
        shown = f"[{shown}]" if ":" in shown else shown
        scheme = "http" if address.certificate is None else "https"
        base = f"{scheme}://{shown}:{port}/login#token="

        def ready() -> None:
            announce((base + tokens.read).encode())
            say(f"view: {base}{tokens.read}")
            if book is not None:
                say(f"view and act: {base}{tokens.act}")
            if scheme == "http" and not _is_loopback(address.host):
                say(
                    "note: without --tls-certificate the token and the pages cross the network unencrypted",
                    err=True,
                )

        with contextlib.suppress(asyncio.CancelledError):
            await serve(site, sock, address, ready)


def site_roots(roots: list[Path]) -> list[Path]:
    """The folders as the page's heading names them."""
    return [root.resolve() for root in roots] or [Path.cwd()]


async def _is_reachable(found: Credentials) -> bool:
    """Whether this machine's coordinator answers."""
    try:
        async with asyncio.timeout(_REACH_S), transport.connect(found) as link:
            await OperatorClient(link).status()
    except (EvopolicyError, TimeoutError):
        return False
    return True


def _credentials(connect: tuple[str, ...], file: Path | None) -> Credentials | None:
    """The operator's; None where none were named and this machine has none."""
    try:
        return credentials.find("operator", connect, file)
    except ConfigError:
        if connect or file:
            raise
        return None


def _roots(runs: list[Path] | None) -> list[Path]:
    for path in runs or ():
        if not path.is_dir():
            raise ConfigError(f"{path} is not a folder; name a folder of runs, such as runs")
    return list(runs) if runs else [path for path in (Path("runs"),) if path.is_dir()]


def _address(http: str) -> tuple[str, int]:
    host, colon, port = http.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not colon or not host or not port.isdecimal() or int(port) >= 1 << 16:
        raise ConfigError(
            f"--http {http!r}: use the form HOST:PORT, such as 127.0.0.1:{DEFAULT_PORT}; port 0 takes a free one"
        )
    return host, int(port)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
