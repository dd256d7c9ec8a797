"""Questions asked of an experiment: check, design, compare."""
