"""What the laws do not know: wind, noise, a plant that differs from the model."""
