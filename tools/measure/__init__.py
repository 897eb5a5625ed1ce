"""How things are measured: child processes and what they take, turns on a busy machine, tables."""
