"""Write a node's roll, pitch and heading as CSV: stamp, degrees."""

import sys

import buddyline
import numpy as np

node, *logs = sys.argv[1:]
attitudes = buddyline.open_dive(*logs).attitudes(node)
x, y, z, w = attitudes.q_ned_body_xyzw.T
roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
print("stamp_ns,roll_deg,pitch_deg,heading_deg")
for stamp_ns, angles in zip(attitudes.stamp_ns, np.degrees([roll, pitch, heading % (2 * np.pi)]).T, strict=True):
    print(f"{stamp_ns}," + ",".join(f"{angle:.2f}" for angle in angles))
