"""Rigorous enclosures of functions on a box: intervals, curves, polynomials, hulls."""
