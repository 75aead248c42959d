"""The report's tables, as data and as CSV, Markdown and LaTeX."""
