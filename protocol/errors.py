"""Errors that a person can act on."""


class BuddylineError(Exception):
    """A known error: one line that names the problem and the remedy; commands exit with 2."""


class MessageError(BuddylineError):
    """A payload that is not a valid message; the text names the field."""
