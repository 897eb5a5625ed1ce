"""The paper's experiments, repeated with the paper's method and with ours: one command, one report."""
