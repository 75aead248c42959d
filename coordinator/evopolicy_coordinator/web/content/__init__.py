"""The content of the live view: run folders and the cluster as they are read, their parts of pages, and how pages are
made."""
