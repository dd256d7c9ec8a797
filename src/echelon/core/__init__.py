"""Words and numbers that know no agent: errors, types, integrators, linear systems."""
