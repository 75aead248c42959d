"""A study: all results of a report on a set of runs, and the look of its agents in figures and pages."""
