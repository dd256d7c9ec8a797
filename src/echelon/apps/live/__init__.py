"""A loop that runs while one watches, and does what the page asks."""
