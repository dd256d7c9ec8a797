"""Pages in the browser: a run as a replay, and a loop that runs while one watches."""
