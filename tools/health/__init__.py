"""The one judge: what is said of machine, rig, nodes, solver and pair. Its limits are in protocol/health.py."""
