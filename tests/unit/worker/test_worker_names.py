"""Names of workers that are given none."""

from __future__ import annotations

from pathlib import Path

from evopolicy_common.wire.credentials import Credentials, TlsFiles
from evopolicy_worker.cli import _other_tier, default_name


def credentials(user: str, folder: Path) -> Credentials:
    certificate = folder / "cert.pem"
    certificate.touch()
    tls = TlsFiles(root_ca=str(certificate), certificate=str(certificate), private_key=str(certificate))
    return Credentials(
        cluster="local", role="worker", endpoints=(), user=user, password="p", token="t", tls=tls
    )


def test_two_workers_of_one_certificate_have_two_names(tmp_path: Path) -> None:
    found = credentials("worker/second", tmp_path)
    assert default_name(found) == "second"
    beside = default_name(found)
    assert beside.startswith("second-")
    assert default_name(found) != beside


def test_a_worker_without_a_certificate_has_a_random_name(tmp_path: Path) -> None:
    found = credentials("worker", tmp_path)
    assert default_name(found) != default_name(found)


def test_a_machine_without_a_tier_is_told_the_safest_that_works_there() -> None:
    assert "--tier landlock works here" in _other_tier(("landlock", "none"))
    assert "--tier none plays policies unconfined" in _other_tier(("none",))
