"""Theorem T5: what is guaranteed under the law `stopping-point`."""
