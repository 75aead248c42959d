"""`evopolicy leaderboard FILES…`: a static site from published results of several labs.

Exit codes: 0 written, 1 no file could be shown, 2 wrong usage.
"""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import Annotated

import typer

from evopolicy_common.cli.conventions import fail, fail_on_our_errors
from evopolicy_common.cli.frame import App
from evopolicy_common.errors import ConfigError
from evopolicy_common.processes.preflight import check_writable
from evopolicy_common.processes.scratch import scratch_folder
from evopolicy_common.terminal import one_line, say
from evopolicy_results.publish.archive import Archive
from evopolicy_results.publish.findings import Findings
from evopolicy_results.publish.replay import replay as replayed
from evopolicy_results.publish.replay import share_of

NOTHING = 1

app = App(name="leaderboard")


@app.command(
    name="leaderboard",
    epilog=(
        "Example: evopolicy leaderboard lab-a.evp lab-b.evp --identity KEY=Lab-A --out site && xdg-open site/index.html"
    ),
)
def leaderboard(
    files: Annotated[list[Path], typer.Argument(metavar="FILES...", help="Published results.")],
    out: Annotated[Path, typer.Option(help="Folder to write; a new one, or an earlier site's.")],
    identity: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY[=NAME]",
            help="Public key of a signer, from another source than the file, and the lab's name;"
            " may be repeated.",
        ),
    ] = None,
    replay: Annotated[
        str | None,
        typer.Option(
            metavar="SHARE",
            help="Replay the recorded actions of `all` episodes, or of a random share of each file: `5%`.",
        ),
    ] = None,
) -> None:
    """Write a leaderboard of several labs' published results as a static site.

    Files that fail their check are listed with the reason, not ranked. Results that cannot be compared get separate
    tables.
    """
    labs: dict[str, str] = {}
    for each in identity or ():
        key, _, name = each.partition("=")
        if not re.fullmatch(r"[0-9a-fA-F]{64}", key):
            fail(
                f"--identity {each!r}: 64 hexadecimal digits, as `evopolicy-coordinator identity` prints them, then"
                " =NAME"
            )
        labs[key.lower()] = name
    for path in files:
        if not path.is_file():
            fail(f"{path}: there is no such file")
    # Here, not above: they need jinja2, and `evopolicy` loads this module to list its commands.
    from evopolicy_results.leaderboard.bundles import read_bundles
    from evopolicy_results.leaderboard.write import write_site

    with fail_on_our_errors(), scratch_folder("leaderboard") as folder:
        share = share_of("--replay", replay)
        check_writable(out, "--out")

        def replay_share(archive: Archive, checked: Findings) -> None:
            if share is not None:
                asyncio.run(replayed(archive, checked, share, lambda played, total: None))

        try:
            bundles = read_bundles(files, labs, Path(folder), replay_share)
        except OSError as error:
            raise ConfigError(f"{error.filename}: {error.strerror}") from error
        shown = [bundle for bundle in bundles if not bundle.refused]
        index = write_site(bundles, out, tell=lambda text: say(one_line(text), err=True))
    for one in bundles:
        if one.refused:
            say(one_line(f"not shown: {one.file}: {one.refused}"), err=True)
    say(f"{len(shown)} of {len(bundles)} files: {index}")
    if not shown:
        raise typer.Exit(NOTHING)
