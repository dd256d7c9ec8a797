"""Theorem T9: what is guaranteed over a network that delays and loses messages."""
