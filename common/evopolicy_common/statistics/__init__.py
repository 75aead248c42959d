"""Intervals and quantiles that reports and the ends of runs share, so that both say the same of one run."""
