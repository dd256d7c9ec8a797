"""What a guarantee says, as one line of text."""

from echelon.output.reports.guarantee_text import guarantee_lines


def in_words(found):
    """Return the rows of a guarantee in one line, without wrapped words."""
    return " ".join(" ".join(guarantee_lines(found, 10_000)).split())
