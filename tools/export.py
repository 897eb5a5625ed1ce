"""`buddyline export`: poses for other programs."""

from __future__ import annotations

import argparse
import csv
import io
import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Rejected, RelativePose, Truth
from buddyline.tools.evaluation.logs import load
from buddyline.tools.newfile import check_new, write_new
from msgspec import UNSET

_SD_FIELDS: Final = ("sd_x_m", "sd_y_m", "sd_z_m", "sd_wx_rad", "sd_wy_rad", "sd_wz_rad")
_CSV_FIELDS: Final = (
    *("stamp_ns", "trigger", "node_a", "node_b"),
    *("t_a_b_x_m", "t_a_b_y_m", "t_a_b_z_m", "q_a_b_x", "q_a_b_y", "q_a_b_z", "q_a_b_w"),
    *_SD_FIELDS,
    *("range_m", "azimuth_rad", "inclination_rad", "t_ned_north_m", "t_ned_east_m", "t_ned_down_m"),
    *("range_gap_m", "twist_gap_rad", "chi2", "hypotheses", "method", "checks", "skew_ns"),
)
_REASON_FIELDS: Final = ("reason", "detail")


def run(args: argparse.Namespace) -> int:
    """Write the poses; return 0."""
    if args.truth and args.format != "tum":
        raise BuddylineError("--truth: only with --format tum")
    if args.rejected and args.format != "csv":
        raise BuddylineError("--rejected: only with --format csv")
    if args.format == "foxglove":
        return _export_foxglove(args)
    if args.output is not None:
        check_new(args.output)
    recorded = load(args.logs, pair=args.pair)
    poses: Sequence[RelativePose | Truth] = recorded.truths if args.truth else recorded.poses
    rejected = recorded.rejected if args.rejected else []
    if not poses and not rejected:
        what = (
            "no truth in it" if args.truth else "no poses in it; solve it first: buddyline solve DIVE.mcap -o OUT.mcap"
        )
        raise BuddylineError(f"{', '.join(args.logs)}: {what}")
    lines = tum_lines(poses) if args.format == "tum" else csv_lines(recorded.poses, rejected, reasons=args.rejected)
    if args.output is None:
        sys.stdout.writelines(lines)
        return 0
    write_new(args.output, "".join(lines))
    return 0


def _export_foxglove(args: argparse.Namespace) -> int:
    from buddyline.tools.dives import Dive
    from buddyline.tools.export_foxglove import export_foxglove

    if args.output is None:
        raise BuddylineError("--format foxglove: give -o FILE.mcap")
    with Dive(args.logs) as dive:
        count = export_foxglove(dive, args.output)
    print(f"{args.output}: {count} messages", file=sys.stderr)
    return 0


def tum_lines(poses: Iterable[RelativePose | Truth]) -> Iterator[str]:
    """Yield `t x y z qx qy qz qw` of T_a_b by time; t in s, with all nine decimals that its ns have."""
    for pose in sorted(poses, key=lambda pose: pose.stamp_ns):
        seconds, rest_ns = divmod(pose.stamp_ns, S_NS)
        numbers = " ".join(map(repr, (*pose.t_a_b_m, *pose.q_a_b_xyzw)))
        yield f"{seconds}.{rest_ns:09d} {numbers}\n"


def csv_lines(poses: Iterable[RelativePose], rejected: Iterable[Rejected], *, reasons: bool) -> Iterator[str]:
    """Yield a header and a row a pose by time; reasons: with two more columns, and rows for rejections."""
    fields = _CSV_FIELDS + (_REASON_FIELDS if reasons else ())
    text = io.StringIO()
    writer = csv.DictWriter(text, fields, restval="", lineterminator="\n")
    writer.writeheader()
    yield text.getvalue()
    results: list[RelativePose | Rejected] = [*poses, *rejected]
    for result in sorted(results, key=lambda result: result.stamp_ns):
        text.seek(0)
        text.truncate()
        writer.writerow(_csv_row(result))
        yield text.getvalue()


def _csv_row(result: RelativePose | Rejected) -> dict[str, object]:
    row: dict[str, object] = {
        name: getattr(result, name)
        for name in ("stamp_ns", "trigger", "node_a", "node_b", *_REASON_FIELDS)
        if hasattr(result, name)
    }
    if isinstance(result, Rejected):
        return row
    t_ned_m = ("", "", "") if result.t_ned_m is UNSET else result.t_ned_m
    variances = result.covariance[::7]
    row |= dict(zip(_CSV_FIELDS[4:11], (*result.t_a_b_m, *result.q_a_b_xyzw), strict=True))
    row |= {name: math.sqrt(v) if v >= 0.0 else "" for name, v in zip(_SD_FIELDS, variances, strict=True)}
    row |= dict(zip(("t_ned_north_m", "t_ned_east_m", "t_ned_down_m"), t_ned_m, strict=True))
    for name in ("range_m", "azimuth_rad", "inclination_rad", "range_gap_m", "twist_gap_rad"):
        value = getattr(result, name)
        row[name] = "" if value is UNSET else value
    row |= {name: getattr(result, name) for name in ("chi2", "hypotheses", "method", "skew_ns")}
    row["checks"] = " ".join(result.checks)
    return row
