"""Links from an agent's process to its vehicle, one file a kind; `link` is the interface."""
