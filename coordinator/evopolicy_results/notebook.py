"""Reports from a notebook: the tables and figures of the paper, and further diagnostics, as typed records.

    from evopolicy_results.notebook import rows, study

    result = study(["runs"])                    # reads every run below; damaged runs are in result.left_out
    core16 = result.suites[0]
    for row in core16.board.standings:          # typed records
        print(row.entry, row.score, row.wins)
    core16.statistics.pairs                     # pairwise comparisons with intervals and tests; see `statistics`
    rows(result.evolutions)                     # a list of dicts for pandas.DataFrame

`study` raises MixedRunsError for runs that are not a fair comparison, unless `allow_mixed=True`. `write_report`
writes the pages of `evopolicy report`; `figures_of` draws the figures one by one; `heldout_returns` is the paper's
own table of scores. Nothing here runs a policy or needs a simulator. Matplotlib is imported when a figure is drawn.
"""

from __future__ import annotations

from evopolicy_results.behaviour.edits import classify, edit_rates
from evopolicy_results.behaviour.trace import trace
from evopolicy_results.figures import figures_of
from evopolicy_results.reading.comparability import MixedRunsError, mixtures
from evopolicy_results.reading.reader import load_runs
from evopolicy_results.reading.records import PastRun, PastSubmit, rows
from evopolicy_results.report import write_report
from evopolicy_results.scoring.scores import heldout_returns, leaderboard, score_table
from evopolicy_results.studies.study import Study, study, study_of
from evopolicy_results.tables.report_tables import tables_of

__all__ = [
    "MixedRunsError",
    "PastRun",
    "PastSubmit",
    "Study",
    "classify",
    "edit_rates",
    "figures_of",
    "heldout_returns",
    "leaderboard",
    "load_runs",
    "mixtures",
    "rows",
    "score_table",
    "study",
    "study_of",
    "tables_of",
    "trace",
    "write_report",
]
