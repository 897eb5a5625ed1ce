"""Solve a dive twice, the second time with lights that are measured 2 % farther apart: the ranges follow."""

import sys

import buddyline
import msgspec
import numpy as np

infos = buddyline.open_dive(*sys.argv[1:]).infos
wider = {
    node: msgspec.structs.replace(
        info,
        light_left_m=tuple(1.02 * value for value in info.light_left_m),
        light_right_m=tuple(1.02 * value for value in info.light_right_m),
    )
    for node, info in infos.items()
}
before = buddyline.solve(*sys.argv[1:], track="none").poses
after = buddyline.solve(*sys.argv[1:], infos=wider, track="none").poses
_, one, other = np.intersect1d(before.trigger, after.trigger, return_indices=True)
print(f"ranges grow by {100 * (np.median(after.range_m[other] / before.range_m[one]) - 1):.2f} %")
