"""Child processes, temporary folders, and the checks of a machine before a command starts."""
