"""evopolicy for notebooks and scripts: evaluate a policy, play whole runs, read finished runs.

```python
import evopolicy as evp

result = evp.evaluate("my_policy/", env="gym/acrobot", cases=range(8))
run = evp.run(env="gym/acrobot", agent=my_function, budget=32)
with evp.Cluster.local(slots=2) as cluster:
    result = cluster.evaluate("my_policy/", env="gym/acrobot")
frames = evp.load_runs("runs/").episodes()
```

Calls that play have an async twin with the suffix `_async`. Names that start with an underscore and the packages
`evopolicy_*` are private. Errors derive from `EvopolicyError`; wrong arguments raise `ConfigError`.
"""

from __future__ import annotations

from evopolicy._arguments import RunKeywords
from evopolicy._cluster import Cluster, evaluate, evaluate_async, run, run_async
from evopolicy._evaluation import Episode, Evaluation
from evopolicy._records import Records
from evopolicy._runs import EpisodeRecord, Run, Runs, SubmitRecord, load_runs
from evopolicy_common import __version__
from evopolicy_common.errors import ConfigError, EvopolicyError
from evopolicy_common.records.run_record import RunSummary
from evopolicy_gateway.agents.function import SubmitRefusedError, Workspace

__all__ = [
    "Cluster",
    "ConfigError",
    "Episode",
    "EpisodeRecord",
    "Evaluation",
    "EvopolicyError",
    "Records",
    "Run",
    "RunKeywords",
    "RunSummary",
    "Runs",
    "SubmitRecord",
    "SubmitRefusedError",
    "Workspace",
    "__version__",
    "evaluate",
    "evaluate_async",
    "load_runs",
    "run",
    "run_async",
]
