"""The law of one agent as source code, for programs without echelon."""
