"""What is guaranteed near the trim: the derivative of the step that runs, and its spectrum."""
