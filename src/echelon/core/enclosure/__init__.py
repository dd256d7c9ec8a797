"""All values of a function on a box, exactly: intervals, curves, polynomials, hulls."""
