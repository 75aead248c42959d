"""The corpus of hostile policies: what each does, the verdict it must get, and how its defence is switched off.

Two kinds. *Probes* (files in `policies/`) try one attack after another and print `held: …` or `THROUGH: …`: their
verdict is an ordinary episode in which every attempt fails. *Breakers* (`breakers.toml`) misbehave at step 3 of an
episode, or before its first; their verdict is the failure's category. docs/explanation/hostile-policies.md is made by

    PYTHONPATH=tests/support python tests/conformance/hostile/corpus.py > docs/explanation/hostile-policies.md
"""

from __future__ import annotations

from collections.abc import Set
from pathlib import Path
from typing import Any

import msgspec
from breakers import BREAKERS
from bundle_attacks import BUNDLES

POLICIES = Path(__file__).parent / "policies"

PROBE = """
import attack

class Policy:
    def __init__(self, *spaces):
        self.n = 0

    def reset(self, episode_index):
        pass

    def act(self, obs):
        self.n += 1
        if self.n == 4:
            for what, attempt in attack.attempts():
                try:
                    got = attempt()
                except BaseException as error:
                    print("held:", what, "-", type(error).__name__, error, flush=True)
                else:
                    print("THROUGH:" if got else "held:", what, "-", repr(got)[:80], flush=True)
        return [0.0]
"""


class Probe(msgspec.Struct, frozen=True):
    """A file of attack attempts."""

    name: str
    off: dict[str, Any] | None
    """Options under which every attempt not in `stays_shut` is seen to succeed: a weaker tier, or no seal; None where
    no unprivileged process of an ordinary machine gets through."""
    stays_shut: Set[str] = frozenset()
    """Attempts that still fail when this defence is off, or that this machine may not support."""
    opens_for_root: Set[str] = frozenset()
    """Attempts that file permissions refuse too, unless the worker runs as root."""
    packages: tuple[str, ...] = ()
    """Packages besides numpy that it imports."""


NO_SEAL = {"tier": "bwrap", "sealed": False}
NO_SANDBOX = {"tier": "none"}

PROBES = (
    Probe("read_files", NO_SANDBOX, {"a hard link", "home folders", "the host's name"}),
    Probe(
        "write_files",
        NO_SANDBOX,
        {"shared memory"},
        opens_for_root={"numpy's folder", "the standard library", "the devices", "the root"},
    ),
    Probe("list_processes", NO_SANDBOX),
    Probe("sockets", NO_SANDBOX, {"interfaces"}),
    Probe(
        "other_processes",
        NO_SANDBOX,
        {
            *("signal 0 to pid 2", "signal 0 to everyone", "being traced", "comparing kernel objects"),
            "memory of its own through process_vm_readv",
        },
    ),
    Probe(
        "kernel",
        NO_SEAL,
        {
            *("an io_uring", "a key", "a new network namespace", "what of a file is in memory"),
            *("being looked into by others", "a process in new namespaces", "watches of file systems"),
        },
    ),
    Probe("descriptors", NO_SANDBOX, {"a lease on a file", "a watch on a folder", "a larger pipe"}),
    Probe("other_files", NO_SANDBOX, {"a file's length by opening it"}),
    Probe("counters", NO_SEAL, {"shared memory of a device", "a huge page"}),
    Probe("kernel_root", None),
    Probe("forks", NO_SANDBOX),
    Probe("exec_itself", NO_SANDBOX),
    Probe(
        "use_scipy",
        NO_SANDBOX,
        {"a compiler by f2py"},
        opens_for_root={"scipy's folder"},
        packages=("scipy",),
    ),
    Probe("devices", NO_SANDBOX, {"kernel messages", "cgroups"}),
)


def document() -> str:
    """docs/explanation/hostile-policies.md: the corpus as a table of verdicts, inside the text of `document.md`."""
    rows = []
    for probe in PROBES:
        first = (POLICIES / f"{probe.name}.py").read_text().split('"""')[1].partition(":")[0].rstrip(".")
        undefended = {"tier": "with tier `none`", "sealed": "unsealed"}
        off = "-" if probe.off is None else undefended["sealed" if "sealed" in probe.off else "tier"]
        rows.append((first, "no access; the episode continues", off))
    for breaker in BREAKERS:
        verdict = f"`{breaker.verdict}`" if breaker.verdict else "harmless; the episode continues"
        ways = ["unsealed"] * breaker.unsealed + ["with a higher limit"] * (breaker.off is not None)
        ways += ["in the environment's process"] * breaker.in_process
        rows.append((breaker.name, verdict, ", ".join(ways) or "-"))
    rows += [(what, "nothing is found", off) for what, off in PAIRS.items()]
    rows += [
        *(
            (bundle.name, f"`{bundle.verdict}`", "by a plain copy" if bundle.harm else "-")
            for bundle in BUNDLES
        ),
        ("a packed bundle with `..` or a root in a path", "the worker refuses it", "by a plain write"),
        (
            "a package `policy/`, or an extension module of that name, beside `policy.py`",
            "`policy.py` is played",
            "with Python's own order of modules",
        ),
        ("a packed bundle with compiled code", "the worker refuses it", "by a plain write"),
    ]
    groups: dict[str, list[tuple[str, str]]] = {}
    for what, verdict, off in rows:
        groups.setdefault(verdict, []).append((what, off))
    lines = [
        f"| {verdict} | {len(attacks)} | {sum(off != '-' for _, off in attacks)} |"
        f" {'; '.join(what.partition(':')[0] for what, _ in attacks[:3])} |"
        for verdict, attacks in groups.items()
    ]
    head = "| verdict | attacks | of these, succeed without the defence | the first |\n|---|--:|--:|---|"
    table = "\n".join([head, *lines])
    return Path(__file__).with_name("document.md").read_text().replace("{table}", table)


PAIRS = {
    "Leaves files, shared memory, and state for the next episode, which searches for them": "with tier `none`",
    "Two policies in parallel slots communicate by files, shared memory, sockets, locks, a page of a shared file, or the timestamps of a device": (  # noqa: E501
        "with tier `none`"
    ),
    "Searches all of its memory for traces of earlier policies of the slot: their number, their durations, their exit statuses": (  # noqa: E501
        "-"
    ),
    "Looks up missing names, which the kernel caches; a policy in another slot measures by timing which ones they were": (  # noqa: E501
        "with tier `none`"
    ),
    "Measures the time between its calls, to guess whether its episode is hidden": "-",
    "Searches all objects, frames and generators for the case's seed": "with tier `none`",
}
"""Attacks that need more than one episode, and how each succeeds without its defence."""


if __name__ == "__main__":
    print(document(), end="")
