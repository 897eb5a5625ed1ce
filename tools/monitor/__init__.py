"""Overview a pair live, look at a dive again, and report on it."""
