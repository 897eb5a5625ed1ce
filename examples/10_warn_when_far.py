"""Warn as soon as the buddy is farther away than so many metres, or was not seen for two seconds."""

import sys
import threading

import buddyline

LIMIT_M = 6.0

with buddyline.live_poses(sys.argv[1] if len(sys.argv) > 1 else "") as poses:
    silence = threading.Timer(2.0, poses.stop)
    silence.start()
    for pose in poses:
        silence.cancel()
        if pose.range_m > LIMIT_M:
            print(f"{pose.node_b} is {pose.range_m:.1f} m away", flush=True)
        silence = threading.Timer(2.0, poses.stop)
        silence.start()
print("no pose for two seconds")
