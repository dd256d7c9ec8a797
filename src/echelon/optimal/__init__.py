"""Agents that solve optimization problems: plans and receding horizons."""
