"""The experiments of the paper, again, with ours beside them: one command, one report."""
