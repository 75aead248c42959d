"""`evopolicy publish`, `evopolicy check`: results that others can check, and the check."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from evopolicy_common.cli.conventions import (
    Connect,
    CredentialsFile,
    Json,
    end_on_sigterm,
    fail,
    fail_on_our_errors,
)
from evopolicy_common.cli.frame import App
from evopolicy_common.console import listing, terminal
from evopolicy_common.errors import ConfigError, ProtocolError
from evopolicy_common.terminal import counted, one_line, say, say_json
from evopolicy_results.cli.cluster import Local, Runs, State, Where, first
from evopolicy_results.publish import replay as replays
from evopolicy_results.publish import rules
from evopolicy_results.publish.archive import Archive
from evopolicy_results.publish.collect import Published, Publisher, find_runs, needles_of_this_machine
from evopolicy_results.publish.contents import Listed
from evopolicy_results.publish.findings import KINDS, Findings

FAILED, NOT_REPLAYED = 1, 3
_SHOWN = 20
_LISTED = "run;entry;environment;experiment;repeat;attempt;state;replaced by"

app = App(name="publish")
check_app = App(name="check")


@app.command(name="publish", epilog="Example: evopolicy publish runs/evolve --out evolve.evp --local")
def publish(
    runs: Runs,
    out: Annotated[Path, typer.Option(help="File to write, such as results.evp.")],
    connect: Connect = None,
    file: CredentialsFile = None,
    local: Local = False,
    state: State = None,
    with_logs: Annotated[bool, typer.Option("--with-logs", help="Publish the agents' logs too.")] = False,
    remove_findings: Annotated[
        bool,
        typer.Option("--remove-findings", help="Leave out policies and recordings that hold keys or tokens."),
    ] = False,
    accept_finding: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FILE:LINE",
            help="Publish this line although it looks like a secret; may be repeated.",
        ),
    ] = None,
    licence: Annotated[
        str, typer.Option(help="Licence of the file, such as CC-BY-4.0.", show_default=False)
    ] = "",
    card: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Also write an evaluation card and a Croissant description into this folder.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write finished runs into one signed file that anyone can check, and make their cases public.

    This cannot be undone: no new run plays cases of the same epoch (see `evopolicy-coordinator epoch`). Paths, host
    names, users, variables and tokens are removed; removed.json in the file lists them. Keys in policies or recordings,
    and values that a run passed to its agent, stop the command: see --remove-findings and --accept-finding.
    """
    where = Where(connect, file, local, state, runs=runs)
    if out.exists():
        fail(f"--out {out} is there already; name a new file")
    if not out.absolute().parent.is_dir():
        fail(f"--out {out}: there is no folder {out.parent}")
    if card is not None and not card.is_dir():
        fail(f"--card {card}: there is no such folder; create it first")

    async def work() -> Published:
        end_on_sigterm()
        finished, left_out = find_runs(runs)
        async with where.link("publish") as (link, _):
            needles = needles_of_this_machine(link, *runs, *([state] if state else []))
            publisher = Publisher(
                link,
                lambda text: say(one_line(text), err=True),
                needles,
                with_logs=with_logs,
                remove_findings=remove_findings,
                accepted=accept_finding or (),
            )
            return await publisher.publish(finished, out, left_out, licence=licence, card=card)

    with fail_on_our_errors():
        done = asyncio.run(work())
    if as_json:
        say_json(done)
        return
    say(f"{done.path}: {counted(done.runs, 'run')}, {done.bytes:,} bytes, signed by {done.signer}")
    say(f"journal head: {done.journal_head}")
    for line in first([f"left out: {each.what}: {each.why}" for each in done.folders_left_out]):
        say(one_line(line))
    say(f"completeness: {done.completeness}; {len(done.folders_left_out)} folders were left out")
    _say_left_out(done.left_out)
    say(f"{len(done.removed)} things were removed; removed.json in the file lists them")
    say(f"next: evopolicy check {done.path} --identity {done.signer}")


@check_app.command(name="check", epilog="Example: evopolicy check results.evp --replay 5% --identity KEY")
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Published results.")],
    replay: Annotated[
        str | None,
        typer.Option(
            metavar="SHARE", help="Replay the recorded actions of `all` episodes, or of a random share: `5%`."
        ),
    ] = None,
    identity: Annotated[
        str | None, typer.Option(help="The expected signer's public key, from another source than the file.")
    ] = None,
    head: Annotated[
        list[str] | None,
        typer.Option(
            metavar="HEAD",
            help="Earlier head of the journal, 64 hexadecimal digits; may be repeated.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Check published results.

    Checks signature, digests, commitments, journal, selection and scores. Executes nothing of the file. Exit codes: 0
    no contradiction, 1 a contradiction, 2 wrong usage, 3 some episodes could not be replayed.
    """
    if identity is not None and not re.fullmatch(r"[0-9a-fA-F]{64}", identity):
        fail(
            f"--identity {identity!r}: 64 hexadecimal digits, as `evopolicy-coordinator identity` prints them"
        )
    for each in head or ():
        if not re.fullmatch(r"[0-9a-fA-F]{64}", each):
            fail(f"--head {each!r}: 64 hexadecimal digits, as `evopolicy-coordinator epoch list` prints them")
    with fail_on_our_errors():
        share = replays.share_of("--replay", replay)
        try:
            with Archive(file) as archive:
                checked = rules.check(archive, identity or "", [each.lower() for each in head or ()])
                if share is None:
                    checked.add("replay", "open", "not asked for; --replay 5% plays recorded actions again")
                elif checked.failed:
                    checked.add("replay", "open", "not played, as the file contradicts itself")
                else:
                    asyncio.run(_replay(archive, checked, share))
        except ProtocolError as error:
            raise ConfigError(f"{file}: {error}") from error
        except OSError as error:
            raise ConfigError(f"{file}: {error.strerror or error}") from error
    if as_json:
        names = ("signer", "findings", "claims", "covered", "listing", "removed")
        shown = {name: getattr(checked, name) for name in names}
        say_json({"file": str(file), "ok": not checked.failed, **shown})
    else:
        _print(checked)
    replayed = share is None or not (
        any(each.kind == "replay" and each.state == "open" for each in checked.findings)
        or any(map(checked.unrecorded, checked.recorded))
    )
    raise typer.Exit(FAILED if checked.failed else 0 if replayed else NOT_REPLAYED)


async def _replay(archive: Archive, checked: Findings, share: float) -> None:
    end_on_sigterm()
    with terminal(stderr=True).status("replay") as status:

        def tell(played: int, total: int) -> None:
            status.update(f"replay: {played} of {total} episodes")

        await replays.replay(archive, checked, share, tell)


def _print(checked: Findings) -> None:
    """One page: a line for each kind that is `ok`, and one for each text of the others."""
    marks = {"ok": "ok    ", "open": "open  ", "failed": "FAILED"}
    grouped = checked.grouped()
    for kind, meaning in KINDS.items():
        of_kind = [(state, text, by) for (of, state, text), by in grouped.items() if of == kind]
        for state in ("failed", "open"):
            texts = [f"{text} [{by}]" if by else text for each, text, by in of_kind if each == state]
            for text in first(texts):
                say(one_line(f"{marks[state]} {kind}: {text}"))
        if of_kind and all(state == "ok" for state, *_ in of_kind):
            n = len({each.run for each in checked.findings if each.kind == kind and each.run})
            text = f"{meaning} ({counted(n, 'run')})" if n else of_kind[0][1]
            say(one_line(f"{marks['ok']} {kind}: {text}"))
    if checked.covered:
        say(f"the replay covered {checked.coverage()} episodes")
    _say_left_out([each for each in checked.listing if each.state != "published"])
    verdict = "nothing in this file contradicts itself"
    if checked.failed:
        verdict = "something in this file contradicts itself or what you expect"
    if without := sum(bool(checked.unrecorded(run)) for run in checked.recorded):
        verdict += (
            f"; {without} of {len(checked.recorded)} runs have episodes without a recording, which no replay can"
            " confirm"
        )
    is_known = checked.state_of("identity") == "ok"
    say(f"verdict: {verdict}; " + ("the signer is the one that you named" if is_known else "self-signed"))


def _say_left_out(listed: Sequence[Listed]) -> None:
    if not listed:
        return
    say("left out, of the same entries:")
    columns = {title: lambda row, n=n: str(row[n]) for n, title in enumerate(_LISTED.split(";"))}
    terminal().print(listing([msgspec.structs.astuple(each) for each in listed[:_SHOWN]], columns))
    if len(listed) > _SHOWN:
        say(f"… and {len(listed) - _SHOWN} more")
