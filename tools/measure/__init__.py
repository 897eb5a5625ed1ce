"""Measure: child processes and their load, times on a busy machine, tables of figures."""
