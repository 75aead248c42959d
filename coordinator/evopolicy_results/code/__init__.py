"""Policy code as data: source files, syntax trees in canonical form, their structure, and differences of lines."""
