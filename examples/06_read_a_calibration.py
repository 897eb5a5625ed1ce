"""Say what a node's calibration is: out of its log, or of a JSON file."""

import math
import sys

import buddyline

for path in sys.argv[1:]:
    info = buddyline.read_info(path)
    across_deg = math.degrees(2 * math.atan(info.width_px / 2 / info.camera.fx_px))
    bar_m = math.dist(info.light_left_m, info.light_right_m)
    print(
        f"node {info.node}: {info.width_px}x{info.height_px} px, {info.camera.model}, {across_deg:.0f} degrees across"
    )
    print(f"  lights {bar_m:.3f} m apart, {1e9 / info.trigger_period_ns:g} pictures a second")
