"""A card as Markdown, and as a description of the file in MLCommons' Croissant 1.1 with RAI 1.0. Pure.

`croissant.json` has the parts that are equal for all files.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from importlib import resources
from typing import NamedTuple, get_args, get_type_hints

import msgspec

from evopolicy_common.records.run_record import RunSummary
from evopolicy_results.publish import contents
from evopolicy_results.publish.card import AgentCost, Card, CardCell

_SHOWN = 4
"""Values of a condition that the text lists."""
_KINDS = {
    contents.RUN: "a run's record",
    contents.OPENING: "a run's case file: its settings and its train, validation and held-out cases",
    contents.EPISODES: "returns of a run's episodes",
}

_DATA_TYPES = {float: "sc:Float", int: "sc:Integer", str: "sc:Text"}


class ArchiveFile(NamedTuple):
    name: str
    sha256: str
    size: int


def files(card: Card, digests: Mapping[str, str], file: ArchiveFile | None = None) -> dict[str, bytes]:
    """The descriptions by name; `digests` and `file` as in `croissant`."""
    data = contents.document(card)
    description = croissant(card, {**digests, contents.CARD: contents.digest(data)}, file)
    return {
        contents.CARD: data,
        contents.CARD_TEXT: markdown(card).encode(),
        contents.CROISSANT: contents.document(description),
    }


def markdown(card: Card) -> str:
    n_runs, envs = len(card.runs), {cell.env for cell in card.results}
    lines = [
        f"""# Evaluation card

Runs: {n_runs}; agents: {len(card.agents)}; environments: {len(envs)}.
Played with evopolicy from {_plain(card.began[:10])} to {_plain(card.ended[:10])}.

The score measures how well an agent improves an executable policy from the feedback of one environment. In
each run an agent edited a policy within a budget of train episodes. Hidden validation cases selected a
checkpoint. The score is the checkpoint's mean return on other hidden cases.

## Results

*Over*: what a repetition of the experiment would draw again, or why there is no interval. *Random*: uniform
random actions on the same cases.
""",
        *_table("environment entry runs mean 95_%_interval over random", map(_result, card.results)),
        "\n## Agents and costs\n\n*Hours*: the runs' wall times. *CPU s*: the agents' own.\n",
        *_table(
            "entry agent runs submits episodes hours CPU_s turns tokens US_dollars", map(_cost, card.agents)
        ),
        "\n## Conditions\n\nThe number of runs stands after values that not all runs have.\n",
    ]
    for topic, names in sorted(card.conditions.items()):
        told = "; ".join(f"{name}: {_values(values, n_runs)}" for name, values in sorted(names.items()))
        lines.append(f"- **{topic.capitalize()}.** {_plain(told)}")
    lines += ["\n## Known limits\n", *(f"- {text}" for text in card.limits)]
    lines.append(f"""
## Licences

Of the published file: {_plain(card.licence) or "not stated"}. Of the packages and assets of the played
families, as the packages state them (none for toys):
""")
    rows = ((each.what, each.version, each.licence, ", ".join(each.used_by)) for each in card.licences)
    lines += _table("package_or_asset version licence families", rows)
    lines.append(f"""
## Who signs, and how to check

- Signed by the Ed25519 key `{_plain(card.signer)}`.
  Compare it with the key that the publisher states elsewhere.
- The journal has {card.journal_entries} entries and the head `{_plain(card.journal_head)}`.
- Completeness: {_plain(card.completeness)}.
- The cases became public at {_plain(card.revealed) or "an unknown time"}.
- `evopolicy check FILE --identity KEY --replay 5%` makes this card again from the runs and replays episodes.
  Published with evopolicy {_plain(card.software)}.
- {_plain(card.canary)}
""")
    return "\n".join(lines)


def _result(cell: CardCell) -> tuple[object, ...]:
    interval = "none" if cell.low is None else f"{_number(cell.low)} to {_number(cell.high)}"
    entry = f"{cell.entry}, from {cell.start}" if cell.start else cell.entry
    return cell.env, entry, cell.runs, _number(cell.mean), interval, cell.over, _number(cell.random)


def _cost(agent: AgentCost) -> tuple[object, ...]:
    hours, cpu_s = f"{agent.wall_s / 3600:.2f}", _number(agent.cpu_s, "not counted")
    counts = agent.runs, agent.submits, agent.episodes, hours, cpu_s, agent.turns
    used = _number(agent.tokens, "not counted"), _number(agent.cost, "not known")
    return agent.entry, "; ".join(agent.agents), *counts, *used


def _table(titles: str, rows: Iterable[tuple[object, ...]]) -> list[str]:
    head = tuple(title.replace("_", " ") for title in titles.split())
    listed = [tuple(_plain(str(each)) for each in row) for row in rows]
    return [f"| {' | '.join(row)} |" for row in (head, ("---",) * len(head), *listed)]


def _plain(text: str) -> str:
    """A text as Markdown shows it, in one line."""
    line = " ".join("".join(each if each.isprintable() else " " for each in text).split())
    return re.sub(r"([\\`*\[\]<>|&])", r"\\\1", line)


def _number(value: float | None, absent: str = "none") -> str:
    return absent if value is None else str(value) if isinstance(value, int) else f"{value:.4g}"


def _values(values: Mapping[str, int], n_runs: int) -> str:
    """The most frequent values, each with its number of runs unless all runs have it."""
    listed = sorted(values.items(), key=lambda each: (-each[1], each[0]))
    more = f", and {len(listed) - _SHOWN} more" if len(listed) > _SHOWN else ""
    return ", ".join(f"{value} ({n})" if n < n_runs else value for value, n in listed[:_SHOWN]) + more


def croissant(card: Card, digests: Mapping[str, str], file: ArchiveFile | None = None) -> dict[str, object]:
    """`croissant.json`. `digests`: of the published files, by name. `file`: describes them as contained in
    it; else as they are beside the description when it is unpacked."""
    contained = {} if file is None else {"containedIn": {"@id": file.name}}
    files = {contents.CARD: "evaluation card, with a row for each run", contents.JOURNAL: "journal"}
    for run in card.runs:
        files |= {f"{run.run}/{name}": text for name, text in _KINDS.items()}
    distribution = [
        {**_file(name, text, digests[name]), "encodingFormat": "application/json", **contained}
        for name, text in files.items()
    ]
    if file is not None:
        whole = _file(file.name, "all files in one signed archive", file.sha256)
        size = {"encodingFormat": "application/zip", "contentSize": f"{file.size} B"}
        distribution.insert(0, {**whole, **size})
    own = {
        "name": f"evopolicy results {card.journal_head[:12]}",
        "description": f"{len(card.runs)} runs in which agents improve policies: records, policies, cases,"
        f" recorded actions, and the journal of the coordinator that played them. {card.canary}",
        "citeAs": f"evopolicy results, journal head {card.journal_head}, signed by {card.signer}",
        "creator": {"@type": "sc:Organization", "name": f"holder of the Ed25519 key {card.signer}"},
        "datePublished": card.revealed,
        "rai:dataCollectionTimeFrame": [card.began, card.ended],
        "rai:dataCollectionMissingData": card.completeness,
        "rai:dataLimitations": list(card.limits),
        "distribution": distribution,
        "recordSet": [
            {
                **_node("cr:RecordSet", "runs", "runs"),
                "field": list(map(_field, RunSummary.__struct_fields__)),
            }
        ],
    }
    shared = msgspec.json.decode(resources.files(__package__).joinpath("croissant.json").read_bytes())
    return {**shared, **own, **({"license": card.licence} if card.licence else {})}


def _node(kind: str, place: str, name: str) -> dict[str, object]:
    return {"@type": kind, "@id": place, "name": name}


def _file(name: str, text: str, sha256: str) -> dict[str, object]:
    return {**_node("cr:FileObject", name, name), "description": text, "contentUrl": name, "sha256": sha256}


def _field(name: str) -> dict[str, object]:
    kind = get_type_hints(RunSummary)[name]
    kind = next(text for of, text in _DATA_TYPES.items() if of in (kind, *get_args(kind)))
    source = {"fileObject": {"@id": contents.CARD}, "extract": {"jsonPath": f"$.runs[*].{name}"}}
    return {**_node("cr:Field", f"runs/{name}", name), "dataType": kind, "source": source}
