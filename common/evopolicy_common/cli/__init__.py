"""What the commands of all rooms share: cluster options, logging, errors and exit codes, help, and usage errors."""
