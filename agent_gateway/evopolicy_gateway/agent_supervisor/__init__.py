"""The process that starts one agent, watches its wall clock, logs its output, and ends its process tree."""
