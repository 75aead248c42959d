"""`evopolicy leaderboard`: a static site from published results of several labs."""
