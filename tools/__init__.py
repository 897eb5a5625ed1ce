"""The command line, and everything that a person runs."""
