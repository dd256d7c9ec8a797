"""Flies a folder of exported laws, one process per vehicle, with the standard library alone."""

__version__ = "0.1.0"


class FlightError(Exception):
    """A flight cannot begin, the link to a vehicle failed, or a page cannot be served.

    `exit_code` is what the command line returns.
    """

    exit_code = 2


class MissingLibraryError(FlightError):
    """A link needs a library that is not installed."""

    exit_code = 4
