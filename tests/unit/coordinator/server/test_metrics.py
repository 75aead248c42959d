"""The metrics, counted from the effects of the real core."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families
from rigs.core_rig import Rig, done

from evopolicy_coordinator.core.contract.effects import Effect
from evopolicy_coordinator.server.monitoring.metrics import Meter

DEPLOY = Path(__file__).parents[4] / "deploy"


class MeteredRig(Rig):
    """A core whose effects a meter sees."""

    def __init__(self, state: Path) -> None:
        super().__init__()
        self.meter = Meter(state, self.status)

    def _carry_out(self, effects: list[Effect]) -> None:
        if hasattr(self, "meter"):
            self.meter.observe(effects)
        super()._carry_out(effects)

    def read(self) -> dict[str, float]:
        """Samples by name and labels."""
        families = text_string_to_metric_families(self.meter.text().decode())
        return {
            sample.name + "".join(f" {value}" for _, value in sorted(sample.labels.items())): sample.value
            for family in families
            for sample in family.samples
        }


@pytest.fixture
def rig(tmp_path: Path) -> MeteredRig:
    return MeteredRig(tmp_path)


def test_episodes_submits_and_leases_of_a_whole_run_are_counted_once(rig: MeteredRig) -> None:
    rig.create(n_valid=2, n_held=3)
    session = rig.register()
    rig.submit(0, 1, 2)
    assert rig.read()["evopolicy_open_runs open"] == 1
    assert rig.read()["evopolicy_queue_jobs toy/line open"] == 3
    rig.pass_time(4.0)
    rig.work_off(session)
    rig.submit(3, key="k1")
    rig.report_results(session, *(done(lease, failure="step_error") for lease in rig.poll(session)))
    rig.finish(session)
    metrics_text = rig.read()
    assert metrics_text["evopolicy_episodes_total train ok"] == 3
    assert metrics_text["evopolicy_episodes_total train step_error"] == 1
    assert metrics_text["evopolicy_episodes_total heldout ok"] == 3
    assert metrics_text["evopolicy_episodes_total random ok"] == 3
    assert metrics_text["evopolicy_submits_total ok"] == 2, "validation stores the rows of submits again"
    assert metrics_text["evopolicy_submit_duration_seconds_count"] == 2
    assert metrics_text["evopolicy_lease_wait_seconds_sum"] == 4.0
    assert metrics_text["evopolicy_leases_total"] >= 10
    assert metrics_text["evopolicy_events_total run_finished info"] == 1
    assert metrics_text["evopolicy_open_runs open"] == 0
    assert metrics_text["evopolicy_slots active"] == 2


def test_a_submit_open_at_a_restart_counts_at_its_end(rig: MeteredRig, tmp_path: Path) -> None:
    rig.create()
    session = rig.register()
    rig.submit(0)
    rig.meter = Meter(tmp_path, lambda: None)
    rig.meter.loaded(rig.core)
    rig.work_off(session)
    metrics_text = rig.read()
    assert metrics_text["evopolicy_submits_total ok"] == 1
    assert metrics_text["evopolicy_up"] == 0


def test_no_label_names_a_run_or_a_worker(rig: MeteredRig) -> None:
    rig.create(run="secret-run", notes={"secret": "secret"})
    rig.register("secretworker")
    rig.submit(0, run="secret-run")
    assert b"secret" not in rig.meter.text()


def test_the_dashboard_asks_for_metrics_that_there_are(rig: MeteredRig) -> None:
    rig.create()
    session = rig.register()
    rig.submit(0)
    rig.work_off(session)
    known = {name.split()[0] for name in rig.read()}
    dashboard = json.loads((DEPLOY / "grafana-dashboard.json").read_text())
    asked = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    assert len(asked) > 10
    for query in asked:
        assert any(name in query for name in known), query
        assert query.count("(") == query.count(")")
