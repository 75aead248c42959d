"""`evopolicy verify`: replays finished episodes and compares the results."""
