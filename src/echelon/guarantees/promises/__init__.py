"""Guarantees for a run, with the hypotheses on which they rest."""
