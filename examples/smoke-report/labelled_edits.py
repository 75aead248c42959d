"""Writes, for each Core16 environment, six versions of a policy whose edits are one of each type: `replay` submits
them.

    python examples/smoke-report/labelled_edits.py OUT

OUT/<environment>/<NN-label>/ is a bundle; the label is the edit type that `evopolicy report` must find for it
(docs/how-to/reports.md). Each version plays the environment's example policy, of which the earlier ones spoil some
actions:

    00-first       uniform random actions only
    01-synthesis   the example, but half of the actions are random
    02-parametric  … a tenth of them
    03-synthesis   the example as it is
    04-retest      the same bytes again
    05-rollback    back to the structure of 01, with another share of random actions
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

POLICIES = Path(__file__).resolve().parents[1] / "policies"

RANDOM = '''"""Uniform random actions."""

import numpy as np


def sample(space):
    """A random action of a Discrete or a Box space."""
    if space["type"] == "Discrete":
        return space.get("start", 0) + np.random.randint(space["n"])
    return np.random.uniform(space["low"], space["high"], space["shape"])


class Policy:
    def __init__(self, obs_space, action_space, env_meta):
        self.space = action_space

    def reset(self, episode_index):
        pass

    def act(self, obs):
        return sample(self.space)
'''

SPOILT = '''"""The expert, with a share of random actions."""

import expert
import numpy as np
import uniform

RANDOM_SHARE = {share}


class Policy(expert.Policy):
    def __init__(self, obs_space, action_space, env_meta):
        super().__init__(obs_space, action_space, env_meta)
        self.actions = action_space

    def act(self, obs):
        action = super().act(obs)
        if np.random.random() < RANDOM_SHARE:
            return uniform.sample(self.actions)
        return action
'''

WHOLE = '''"""The expert as it is."""

from expert import Policy

__all__ = ["Policy"]
'''


def versions(expert: dict[str, str]) -> dict[str, dict[str, str]]:
    """Label to files, in the order of their submits. `expert`: the example's files by name."""
    parts = {("expert.py" if name == "policy.py" else name): text for name, text in expert.items()}

    def spoilt(share: float) -> dict[str, str]:
        return {**parts, "uniform.py": RANDOM, "policy.py": SPOILT.format(share=share)}

    whole = {**parts, "policy.py": WHOLE}
    return {
        "00-first": {"policy.py": RANDOM},
        "01-synthesis": spoilt(0.5),
        "02-parametric": spoilt(0.1),
        "03-synthesis": whole,
        "04-retest": whole,
        "05-rollback": spoilt(0.25),
    }


def write(out: Path) -> None:
    """Writes all environments' versions below `out`, in place of what is there."""
    for example in sorted(path for path in POLICIES.iterdir() if (path / "policy.py").is_file()):
        expert = {path.name: path.read_text(encoding="utf-8") for path in example.glob("*.py")}
        folder = out / example.name
        shutil.rmtree(folder, ignore_errors=True)
        for label, files in versions(expert).items():
            (folder / label).mkdir(parents=True)
            for name, text in files.items():
                (folder / label / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: labelled_edits.py OUT")
    write(Path(sys.argv[1]))
