"""Numbers of a `Result`: metrics, the Lyapunov function, the dataset."""
