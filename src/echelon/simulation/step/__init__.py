"""One step of the closed loop: what an agent knows, does and sends; how agents move; what is measured."""
