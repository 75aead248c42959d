"""The process that starts one agent, watches its clock, logs its output, and ends what it leaves."""
