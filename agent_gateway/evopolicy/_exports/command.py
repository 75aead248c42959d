"""`evopolicy export`: finished or running runs in the formats of other tools."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from evopolicy_common.cli.conventions import fail_on_our_errors
from evopolicy_common.cli.frame import App
from evopolicy_common.errors import ConfigError, EvopolicyError
from evopolicy_common.installation import add_extra
from evopolicy_common.processes.preflight import check_writable
from evopolicy_common.terminal import say, say_lines

if TYPE_CHECKING:
    from evopolicy import Runs

app = App()


Format = Literal["csv", "parquet", "tensorboard", "mlflow", "wandb", "minari", "atif", "inspect"]


@app.command("export", epilog="Example: evopolicy export runs/ --to parquet --out tables")
def export(
    runs: Annotated[list[Path], typer.Argument(help="Run directories, or folders of them.")],
    to: Annotated[
        Format,
        typer.Option(
            help=(
                "csv and parquet: tables of runs, submits and episodes. tensorboard, mlflow, wandb: returns over the"
                " budget."
                " minari: train episodes as datasets. atif, inspect: agents' logs."
            )
        ),
    ],
    out: Annotated[
        str,
        typer.Option(
            help="Folder to write, or tracking URI for mlflow. Default: export-FORMAT, or $MLFLOW_TRACKING_URI."
        ),
    ] = "",
    follow: Annotated[
        bool,
        typer.Option("--follow", help="Continue until all runs are finished (tensorboard, mlflow, wandb)."),
    ] = False,
) -> None:
    """Export runs to tables, experiment trackers, trajectory datasets and agents' logs.

    A repeated call adds new submits to a tracker, and replaces tables and logs.
    """
    with fail_on_our_errors():
        if follow and to not in _TRACKERS:
            raise ConfigError(f"--follow: {to} is written at once; {', '.join(_TRACKERS)} can follow")
        default = f"export-{to}"
        if to == "mlflow":
            default = os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{default}.db"
        try:
            if to in _TRACKERS:
                from evopolicy._exports import tracking

                tracker = getattr(tracking, _TRACKERS[to])(out or default)
                for name in tracking.track(runs, tracker, follow=follow):
                    say_lines([name])
            else:
                _write(runs, to, Path(out or default))
        except ModuleNotFoundError as error:
            extra = to if to in ("mlflow", "wandb") else "export"
            raise ConfigError(
                f"--to {to} needs {error.name}, which is not installed: {add_extra(extra)}"
            ) from error
        except (EvopolicyError, OSError):
            raise
        except (
            Exception
        ) as error:  # the tools' libraries have errors of many kinds: a server is away, a disk is full
            raise ConfigError(f"--to {to}: {error}") from error


def _write(runs: list[Path], to: Format, out: Path) -> None:
    from evopolicy import load_runs
    from evopolicy._exports import tables, trajectories, transcripts

    writers: dict[Format, Callable[[Runs, Path], list[Path]]] = {
        "csv": tables.write_csv,
        "parquet": tables.write_parquet,
        "minari": trajectories.write_minari,
        "atif": transcripts.write_atif,
        "inspect": transcripts.write_inspect,
    }
    runs_read = load_runs(*runs)
    for folder, why in runs_read.left_out:
        say(f"{folder}: left out: {why}", err=True)
    check_writable(out, "--out")
    out.mkdir(parents=True, exist_ok=True)
    say_lines(map(str, writers[to](runs_read, out)))


_TRACKERS = {"tensorboard": "TensorBoard", "mlflow": "MLflow", "wandb": "WeightsAndBiases"}
"""Classes of `tracking`, each of which takes --out."""
