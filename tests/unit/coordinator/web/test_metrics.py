"""The live view's metrics, from the status of the real core."""

from __future__ import annotations

import json
from pathlib import Path

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families
from rigs.core_rig import Rig

from evopolicy_common.messages.status import StatusReply
from evopolicy_coordinator.web.content.metrics import StatusCollector

DEPLOY = Path(__file__).parents[4] / "deploy"


def read(status: StatusReply | None) -> dict[str, float]:
    """Samples by name and labels."""
    registry = CollectorRegistry()
    registry.register(StatusCollector(lambda: status))
    return {
        sample.name + "".join(f" {value}" for _, value in sorted(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(generate_latest(registry).decode())
        for sample in family.samples
    }


def test_workers_and_runs_are_counted_by_state_and_no_label_names_them() -> None:
    rig = Rig()
    rig.create(agent="secret-kernel", notes={"secret": "secret"})
    session = rig.register("secretworker")
    rig.submit(0, 1, 2)
    before = read(rig.status())
    assert before["evopolicy_up"] == before["evopolicy_open_runs open"] == 1
    assert before["evopolicy_queue_jobs toy/line open"] == 3
    assert before["evopolicy_slots active"] == 2
    rig.work_off(session)
    rig.finish(session)
    after = read(rig.status())
    assert after["evopolicy_open_runs open"] == after["evopolicy_open_runs finished"] == 0
    assert not [name for name in before | after if "secret" in name or " r1" in name]


def test_a_coordinator_that_does_not_answer_is_down() -> None:
    assert read(None) == {"evopolicy_up": 0}


def test_the_dashboard_asks_for_metrics_that_there_are() -> None:
    rig = Rig()
    rig.create()
    rig.register()
    rig.submit(0)
    known = {name.split()[0] for name in read(rig.status())}
    known |= {"evopolicy_store_database_bytes", "evopolicy_store_free_bytes"}
    dashboard = json.loads((DEPLOY / "grafana-dashboard.json").read_text())
    asked = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    assert len(asked) > 5
    for query in asked:
        assert any(name in query for name in known), query
        assert query.count("(") == query.count(")")
