"""Draw both nodes' depths over time (needs matplotlib: make install EXTRAS=plots)."""

import sys

import buddyline
from matplotlib.figure import Figure

*logs, picture = sys.argv[1:]
dive = buddyline.open_dive(*logs)
figure = Figure(figsize=(8, 4))
axes = figure.subplots()
for node in dive.nodes:
    depths = dive.depths(node)
    axes.plot(depths.time_s, depths.depth_m, label=f"node {node}")
axes.invert_yaxis()
axes.set(xlabel="time (s)", ylabel="depth (m)")
axes.legend()
figure.savefig(picture)
print(f"wrote {picture}")
