"""Faults injected into the real system from outside: `python -m tests.faults`."""
