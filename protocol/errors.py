"""Errors that a person can act on."""


class BuddylineError(Exception):
    """A known error: one line that names what is wrong and what to do; commands exit with 2."""


class MessageError(BuddylineError):
    """A payload that is not a sound message; the text names the field."""
