"""Independent verification of saved gains and tubes; only the agent models are shared."""
