"""Published results of two runs that were really played, and a forger who changes them and signs them again."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
from commands import agent, evopolicy
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from evopolicy_common.errors import ProtocolError
from evopolicy_common.messages.operator import RunResult
from evopolicy_common.records import journal
from evopolicy_common.records.aggregates import mean, std
from evopolicy_common.records.episodes.trajectory import Recorder, decode
from evopolicy_common.records.run_record import decode_run_record
from evopolicy_coordinator.pki import identity
from evopolicy_results.publish import card as cards
from evopolicy_results.publish import contents, descriptions
from evopolicy_results.publish.archive import Archive, ArchiveWriter
from evopolicy_results.publish.run_rules import return_of

ENV = "toy/line"
CONSTANT = """
class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        pass
    def reset(self, episode_index):
        pass
    def act(self, obs):
        return {}
"""
AGENT = f"""
submit_policy({CONSTANT.format(1)!r}, [0, 1])
submit_policy({CONSTANT.format(0)!r}, [2, 0, 1])
"""


class Results:
    """A state folder with two runs of one entry, and files of published results."""

    def __init__(self, root: Path) -> None:
        self.root = root
        own = ("--agent", agent(root, AGENT), "--entry", "mine")
        numbers = ("--budget", "5", "--validation", "2", "--heldout", "3", "--state", "st")
        for exp_id in ("first", "second"):
            evopolicy(root, "local", "--env", ENV, *numbers, *own, "--exp-id", exp_id, code=0)
        self.summary = self.publish("all.evp", "runs")
        self.files = self.read_file("all.evp")

    def publish(self, out: str, *runs: str) -> dict[str, Any]:
        state = ("--local", "--state", "st", "--json")
        done = evopolicy(self.root, "publish", *runs, "--out", out, *state, code=0)
        document: dict[str, Any] = json.loads(done.stdout)
        return document

    def read_file(self, name: str) -> dict[str, bytes]:
        return read(self.root / name)

    def run_folder(self, exp_id: str) -> str:
        return str(next(self.root.glob(f"runs/*/*/{exp_id}")).relative_to(self.root))


class Held:
    """Files in memory."""

    def __init__(self, files: dict[str, bytes]) -> None:
        self.files = files

    @property
    def names(self) -> frozenset[str]:
        return frozenset(self.files)

    def read_file(self, name: str, most: int) -> bytes:
        if name not in self.files:
            raise ProtocolError(f"{name} is missing")
        return self.files[name]


class Forger:
    """Changes published files."""

    def __init__(self, files: dict[str, bytes]) -> None:
        self.files = dict(files)
        self.described = {name: files.get(name) for name in contents.DESCRIPTIONS}

    def json(self, name: str, change: Callable[[Any], Any]) -> None:
        """Changes a document in place, or into what `change` returns."""
        document = json.loads(self.files[name])
        new = change(document)
        self.put(name, document if new is None else new)

    def put(self, name: str, content: Any) -> None:
        """Writes a document as the software does."""
        self.files[name] = spelt(name, content)

    def text(self, name: str, before: bytes, after: bytes) -> None:
        assert before in self.files[name]
        self.files[name] = self.files[name].replace(before, after, 1)

    def rerecord(self, group: str, change: Callable[[Any], tuple[Any, float]], n: int = 1) -> None:
        """Other actions and rewards, as `change` makes them of each step, in the first `n` recordings."""
        name = f"runs/0000/actions/{group}"
        recordings = contents.unpack_recordings(self.files[name])
        for place, data in enumerate(recordings[:n]):
            assert data is not None
            recorder = Recorder("actions")
            for row in decode(data).rows():
                action, reward = change(row)
                recorder.append(None, action, reward, row.terminated, row.truncated, {})
            recordings[place] = recorder.finish()
        self.files[name] = contents.pack_recordings(recordings)

    def returns(self, group: str) -> list[float]:
        """The sums of the rewards in a group's recordings."""
        recordings = contents.unpack_recordings(self.files[f"runs/0000/actions/{group}"])
        return [return_of(decode(data)) for data in recordings if data is not None]

    def entries(self, change: Callable[[list[bytes]], list[bytes]]) -> None:
        """Changes the journal, and what `run.json` tells of it, as its owner could who begins another."""
        lines = change(contents.journal_entries(self.files[contents.JOURNAL]))
        self.files[contents.JOURNAL] = contents.journal_lines(lines)

    def begin_anew(self, change: Callable[[dict[str, Any]], Any], folder: str = "runs/0000") -> None:
        """Changes a run's result as a coordinator could that cheats from the start: journal, `run.json`, and returns
        agree."""
        name = f"{folder}/{contents.RESULT}"
        self.json(name, change)
        result = json.loads(self.files[name])
        returns = result["heldout_returns"]
        groups = json.loads(self.files[f"{folder}/{contents.EPISODES}"])
        for group in groups:
            if (group["split"], group["submit_index"]) == ("heldout", result["best_submit_index"]):
                for episode, value in zip(group["episodes"], returns, strict=True):
                    episode["episode_return"] = value
        self.put(f"{folder}/{contents.EPISODES}", groups)

        def score(record: dict[str, Any]) -> None:
            record["outcome"] |= {
                "heldout_returns": returns,
                "final_score": mean(returns),
                "heldout_mean_return": mean(returns),
                "heldout_std_return": std(returns),
            }

        self.json(f"{folder}/{contents.RUN}", score)

        def entries(lines: list[bytes]) -> list[bytes]:
            own = [json.loads(line) for line in lines]
            for each in own:
                if each["kind"] == "ended" and each["run"] == result["run"]:
                    each["result"] = contents.digest(self.files[name])
            return [spelt(contents.JOURNAL, each) for each in own]

        self.entries(entries)

    def raise_returns(self, change: Callable[[list[float]], list[float]]) -> None:
        """Changes the held-out returns of the first run, and all that the journal and `run.json` tell of them."""

        def told(result: dict[str, Any]) -> None:
            result["heldout_returns"] = change(result["heldout_returns"])
            result["final_score"] = mean(result["heldout_returns"])

        self.begin_anew(told)

    def invent_returns(self) -> None:
        """Held-out returns that nobody got, without the recordings that would contradict them."""
        self.raise_returns(lambda old: [each + 100.0 for each in old])
        del self.files["runs/0000/actions/heldout-001"]

    def place(self) -> None:
        """Tells the places and heads that the journal has in every `run.json`."""
        lines = contents.journal_entries(self.files[contents.JOURNAL])
        heads, entries = journal.heads(lines), [json.loads(line) for line in lines]
        for name in [name for name in self.files if name.endswith(f"/{contents.RUN}")]:
            record = json.loads(self.files[name])
            for number, each in enumerate(entries):
                if each.get("run") == record["run"]:
                    record["committed"] |= {each["kind"]: number, f"{each['kind']}_head": heads[number]}
            self.put(name, record)

    def sign(self, state: Path | None = None) -> None:
        """Makes digests, head and signature anew, with the key of the coordinator in `state`, or a key of the
        forger's."""
        folders = sorted({name[:9] for name in self.files if name.startswith("runs/")})
        manifest = json.loads(self.files[contents.MANIFEST])
        manifest["files"] = {}
        for folder in folders:
            own = {
                name.removeprefix(f"{folder}/"): contents.digest(data)
                for name, data in self.files.items()
                if name.startswith(f"{folder}/") and not name.endswith(contents.DIGESTS)
            }
            self.files[f"{folder}/{contents.DIGESTS}"] = contents.document(own)
            manifest["files"][f"{folder}/{contents.DIGESTS}"] = contents.digest(contents.document(own))
        self.describe(state)
        for name in {contents.JOURNAL, contents.REMOVED, *contents.DESCRIPTIONS} & self.files.keys():
            manifest["files"][name] = contents.digest(self.files[name])
        lines = contents.journal_entries(self.files[contents.JOURNAL])
        manifest["journal_entries"], manifest["journal_head"] = len(lines), journal.heads(lines)[-1]
        self.files[contents.MANIFEST] = contents.document(msgspec.convert(manifest, contents.Manifest))
        self.sign_manifest(state)

    def describe(self, state: Path | None = None) -> None:
        """Makes the card and its descriptions anew from the files, unless the forger changed these. Keeps them
        where a file cannot be read."""
        now = {name: self.files.get(name) for name in contents.DESCRIPTIONS}
        if now != self.described or contents.CARD not in self.files:
            return
        try:
            sources = [
                cards.CardSource(
                    name[:9],
                    decode_run_record(data),
                    msgspec.json.decode(self.files[f"{name[:9]}/{contents.RESULT}"], type=RunResult),
                )
                for name, data in sorted(self.files.items())
                if name.endswith(f"/{contents.RUN}")
            ]
            card = cards.make(
                sources,
                contents.journal_entries(self.files[contents.JOURNAL]),
                signer=key_of(state),
                software=json.loads(self.files[contents.MANIFEST])["software"],
            )
        except (ProtocolError, msgspec.MsgspecError, KeyError, ValueError):
            return
        digests = {name: contents.digest(data) for name, data in self.files.items()}
        self.files |= descriptions.files(card, digests)

    def sign_manifest(self, state: Path | None = None) -> None:
        """Makes the signature anew, of the manifest as it is."""
        digest = contents.digest(self.files[contents.MANIFEST])
        signature = FORGER.sign(b"evopolicy manifest 1\0" + bytes.fromhex(digest)).hex()
        if state is not None:
            _, signature = identity.sign(state, digest)
        self.put(contents.SIGNATURE, {"key": key_of(state), "signature": signature})

    def write(self, path: Path) -> None:
        """The files as an archive."""
        written(path, self.files)


def written(path: Path, files: dict[str, bytes]) -> Path:
    """These files as an archive."""
    writer = ArchiveWriter(path)
    for name, data in files.items():
        writer.add(name, data)
    writer.close()
    return path


def read(path: Path) -> dict[str, bytes]:
    """The files of an archive."""
    with Archive(path) as archive:
        return {each: archive.read_file(each, 1 << 30) for each in archive.names}


FORGER = Ed25519PrivateKey.from_private_bytes(b"f" * 32)


def key_of(state: Path | None) -> str:
    """The public key of the coordinator in `state`, or the forger's."""
    if state is not None:
        return identity.sign(state, "00" * 32)[0]
    return FORGER.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw).hex()


def spelt(name: str, content: Any) -> bytes:
    """JSON in the one spelling that published files have."""
    if name.endswith(contents.RUN):
        return msgspec.json.format(msgspec.json.encode(content), indent=2) + b"\n"
    data = msgspec.json.encode(content, order="sorted")
    return data if name.endswith((contents.OPENING, contents.RESULT, contents.JOURNAL)) else data + b"\n"
