"""Published results: runs in one signed file, and its check by anyone. `rules` are pure; `archive` alone reads a file's
bytes."""
