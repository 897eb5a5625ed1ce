"""The demo: simulated nodes, hub and solver on this machine, and their state as text."""
