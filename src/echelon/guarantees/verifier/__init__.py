"""A second opinion on a gain file, which shares nothing with what made it but the models."""
