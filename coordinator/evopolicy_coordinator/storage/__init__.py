"""The state folder: database, blobs, backups, and the disk space that they use."""
