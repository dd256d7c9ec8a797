"""Flight: one process per agent, with its exported law; it needs the standard library alone."""
