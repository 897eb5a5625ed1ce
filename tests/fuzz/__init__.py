"""Broken and hostile input: all of it is accepted or refused with a known error; anything else is a failure."""
