"""The one place that says what is promised of what runs."""
