"""Print the poses of a running pair as the solver finds them, for some seconds."""

import sys

import buddyline

endpoint = sys.argv[1] if len(sys.argv) > 1 else ""
seconds = float(sys.argv[2]) if len(sys.argv) > 2 else None
with buddyline.live_poses(endpoint, seconds=seconds) as poses:
    for pose in poses:
        print(f"{pose.node_a}/{pose.node_b} {pose.trigger}: {pose.range_m:.3f} m ({pose.method})", flush=True)
