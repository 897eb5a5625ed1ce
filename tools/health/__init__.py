"""Judge the health of machine, rig, nodes, solver and pair, for all commands. The limits: protocol/health.py."""
