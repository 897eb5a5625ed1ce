"""The one place where errors are computed: poses and candidates measured against truth.

`result.evaluate` is a pure function of messages; `logs` reads them, `report` and `plots` show what came out. It
shares no geometry with the solver or the simulator, so that a mistake of theirs cannot cancel here.
"""
