"""Compare poses, tracks and candidates with truth. This is the only place in the project that computes errors.

`result.evaluate` is a pure function of messages; `logs` reads them, and `report` prints the results. It shares no
geometry with the solver or the simulator, so that an error of theirs cannot cancel here.
"""
