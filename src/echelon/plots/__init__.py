"""Answers in pictures."""
