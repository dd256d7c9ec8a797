"""Parts in, one `Result` out: the closed loop in time."""
