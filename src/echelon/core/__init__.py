"""Foundations without agent models: errors, types, integrators, linear systems, caching."""
