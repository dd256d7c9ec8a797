"""The world of a run: wind, noise and a plant that differs from the model."""
