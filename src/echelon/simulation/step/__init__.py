"""One step of the closed loop: what an agent knows, does and sends, and how it moves."""
