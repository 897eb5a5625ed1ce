"""`buddyline export`: write the track, or the poses, for other programs."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Final

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Rejected, RelativePose, Track, Truth
from buddyline.protocol.topics import POSE, TRACK, TRACK_LAG
from buddyline.tools.columns import in_order, of_mode
from buddyline.tools.evaluation.logs import load
from buddyline.tools.evaluation.network import shows_network
from buddyline.tools.evaluation.recorded import Recorded
from buddyline.tools.evaluation.rotation import Floats
from buddyline.tools.evaluation.truth import TruthTrack
from buddyline.tools.export.formats import ExportFormat, format_of
from buddyline.tools.measure.tables import csv_lines, tum_line
from buddyline.tools.newfile import check_new, write_new
from buddyline.tools.progress import counted
from msgspec import UNSET

_AXES: Final = ("x", "y", "z", "wx", "wy", "wz")
_UPPER: Final = [(row, column) for row in range(6) for column in range(row, 6)]
_SD_FIELDS: Final = ("sd_x_m", "sd_y_m", "sd_z_m", "sd_wx_rad", "sd_wy_rad", "sd_wz_rad")
_PLACE_FIELDS: Final = (
    *("t_a_b_x_m", "t_a_b_y_m", "t_a_b_z_m", "q_a_b_x", "q_a_b_y", "q_a_b_z", "q_a_b_w"),
    *_SD_FIELDS,
    *("range_m", "azimuth_rad", "inclination_rad", "t_ned_north_m", "t_ned_east_m", "t_ned_down_m"),
)
_NED_SD_FIELDS: Final = (*("sd_azimuth_rad", "sd_inclination_rad", "sd_ned_north_m", "sd_ned_east_m", "sd_ned_down_m"),)
# The true pose at the row's time, where the logs have the truth.
_TRUTH_FIELDS: Final = (
    *("truth_t_a_b_x_m", "truth_t_a_b_y_m", "truth_t_a_b_z_m"),
    *("truth_q_a_b_x", "truth_q_a_b_y", "truth_q_a_b_z", "truth_q_a_b_w"),
)
_CSV_FIELDS: Final = (
    *("stamp_ns", "trigger", "node_a", "node_b"),
    *_PLACE_FIELDS,
    *("range_gap_m", "twist_gap_rad", "chi2", "hypotheses", "method", "checks", "skew_ns"),
    *_NED_SD_FIELDS,
    "heading_gap_rad",
    # The row-major upper triangle, in m and rad.
    *(f"cov_{_AXES[row]}_{_AXES[column]}" for row, column in _UPPER),
    *_TRUTH_FIELDS,
)
NO_POSES: Final = "no poses in it; solve it first: buddyline solve DIVE.mcap -o OUT.mcap"
NO_TRACK: Final = "no track in it; solve it: buddyline solve DIVE.mcap -o OUT.mcap"
_REASON_FIELDS: Final = ("reason", "detail")
_TRACK_FIELDS: Final = (
    *("stamp_ns", "node_a", "node_b", "mode"),
    *_PLACE_FIELDS,
    *_NED_SD_FIELDS,
    *("v_a_b_x_mps", "v_a_b_y_mps", "v_a_b_z_mps", "lights", "age_s"),
    # Row-major upper triangles, in m, rad and m/s.
    *(f"cov_{_AXES[row]}_{_AXES[column]}" for row, column in _UPPER),
    *(f"cov_v{_AXES[row]}_v{_AXES[column]}" for row, column in _UPPER if column < 3),
    *_TRUTH_FIELDS,
)


def run(args: argparse.Namespace) -> int:
    """Write the track or the poses; return 0."""
    if args.output == Path("-"):
        args.output = None
    form = format_of(args.format)
    if args.truth and args.format != "tum":
        raise BuddylineError("--truth: only with --format tum")
    if args.rejected and not form.table:
        raise BuddylineError("--rejected: only with --format csv or parquet")
    if args.what == "track" and (args.truth or args.rejected):
        raise BuddylineError(f"--what track: not with {'--truth' if args.truth else '--rejected'}")
    of_net = args.format == "trc" or args.what == "net"
    if args.node is not None and not of_net:
        raise BuddylineError("--node: only with --what net")
    if form.module and args.output is None:
        raise BuddylineError(f"--format {form.name}: give -o FILE")
    if args.output is not None:
        check_new(args.output)
    if form.module and not form.table:
        return _export_file(args, form)
    of_pair = {
        f"--what {args.what}": args.what in ("poses", "track"),
        "--truth": args.truth,
        "--rejected": args.rejected,
        "--pair": args.pair is not None,
    }
    if of_net and any(of_pair.values()):
        given = ", ".join(name for name, is_given in of_pair.items() if is_given)
        raise BuddylineError(f"{given}: not with all nodes of a net")
    if form.table:
        what = _write_table(args, form)
    else:
        what, lines = _network_lines(args) if of_net else _lines(args, _of_pair(args))
        _write_text(args.output, lines)
    print(f"{args.output or ', '.join(args.logs)}: {what}", file=sys.stderr)
    return 0


def _frame_words(args: argparse.Namespace, recorded: Recorded) -> str:
    """Return which node's frame it is in, where --pair named the nodes the other way round."""
    a, b = recorded.nodes
    return f"; the log has {a}/{b}: it is {b} in {a}'s frame" if args.pair == (b, a) else ""


def _write_table(args: argparse.Namespace, form: ExportFormat) -> str:
    """Write rows and columns; return what they are of, in words."""
    if args.what == "net":
        from buddyline.tools.export.network import network_rows

        said, names, rows = network_rows(args.logs, args.node)
    else:
        recorded = _of_pair(args)
        said, names, rows = rows_of(recorded, args.what, ", ".join(args.logs), rejected=args.rejected)
        said += _frame_words(args, recorded)
    if form.module:
        import_module(f"buddyline.tools.export.{form.module}").write(args.output, said, names, rows)
    else:
        _write_text(args.output, csv_lines(names, ([row.get(name, "") for name in names] for row in rows)))
    return said


def _write_text(output: Path | None, lines: Iterable[str]) -> None:
    if output is None:
        sys.stdout.writelines(lines)
    else:
        write_new(output, "".join(lines))


def _of_pair(args: argparse.Namespace) -> Recorded:
    try:
        return load(args.logs, pair=args.pair)
    except BuddylineError as error:
        if args.pair is None and shows_network(args.logs):
            raise BuddylineError(f"{error}, or all nodes with --what net") from error
        raise


def _lines(args: argparse.Namespace, recorded: Recorded) -> tuple[str, Iterator[str]]:
    """Return what is exported, in words, and its lines."""
    name = ", ".join(args.logs)
    if args.truth:
        if not recorded.truths:
            raise BuddylineError(f"{name}: no truth in it")
        said = f"the truth, {len(recorded.truths)} rows"
        return said + _frame_words(args, recorded), tum_lines(recorded.truths)
    said, estimates = chosen(recorded, args.what, name)
    return said + _frame_words(args, recorded), tum_lines(estimates)


def chosen(recorded: Recorded, what: str | None, name: str) -> tuple[str, list[RelativePose] | list[Track]]:
    """Return the best track, or the poses, in words and in order; what: "track", "poses", or None for the better."""
    track = [] if what == "poses" else in_order(of_mode(recorded.tracks))
    if what == "track" and not track:
        raise BuddylineError(f"{name}: {NO_TRACK}")
    if track:
        other = "; `export --what poses` gives the poses" if what is None and recorded.poses else ""
        return f"the track ({track[0].mode}), {len(track)} rows{other}", track
    if not recorded.poses:
        raise BuddylineError(f"{name}: {NO_POSES}")
    return f"the poses, {len(recorded.poses)} rows", recorded.poses


def rows_of(
    recorded: Recorded, what: str | None, name: str, *, rejected: bool = False
) -> tuple[str, tuple[str, ...], list[dict[str, object]]]:
    """Return what is exported, in words, its columns, and its rows by time; an unknown value is absent or "".

    rejected: the poses, with two more columns, and rows for rejections.
    """
    truth = TruthTrack(recorded.truths)
    if rejected:
        results: list[RelativePose | Rejected] = [*recorded.poses, *recorded.rejected]
        if not results:
            raise BuddylineError(f"{name}: {NO_POSES}")
        rows = [_csv_row(one, truth) for one in sorted(results, key=lambda result: result.stamp_ns)]
        said = f"the poses, {len(recorded.poses)} rows, and {len(recorded.rejected)} rows of triggers without one"
        return said, _CSV_FIELDS + _REASON_FIELDS, rows
    said, estimates = chosen(recorded, what, name)
    tracks = [one for one in estimates if isinstance(one, Track)]
    if tracks:
        return said, _TRACK_FIELDS, [_track_csv_row(one, truth) for one in counted(tracks, "export")]
    poses = sorted((one for one in estimates if isinstance(one, RelativePose)), key=lambda pose: pose.stamp_ns)
    return said, _CSV_FIELDS, [_csv_row(pose, truth) for pose in poses]


def _network_lines(args: argparse.Namespace) -> tuple[str, Iterator[str]]:
    from buddyline.tools.export.network import network_lines

    return network_lines(args.logs, args.format, args.node, str(args.output or "buddyline.trc"))


def _export_file(args: argparse.Namespace, form: ExportFormat) -> int:
    from buddyline.tools.dives import Dive, first_with_net

    if form.of_net and args.what not in (None, "net"):
        raise BuddylineError(f"--format {form.name} --what {args.what}: it has all nodes")
    if args.node is not None or args.pair is not None:
        raise BuddylineError(f"--format {form.name}: it has all nodes and pairs, without --node and --pair")
    module = import_module(f"buddyline.tools.export.{form.module}")
    with Dive(args.logs) as dive:
        if args.what == "net":
            first_with_net([dive])
        wanted = {"poses": (POSE,), "track": (TRACK, TRACK_LAG)}.get(args.what, ())
        if wanted and not dive.ids(*(topic.name for topic in wanted)):
            raise BuddylineError(f"{dive.name}: {NO_TRACK if args.what == 'track' else NO_POSES}")
        count = module.export(dive, args.output, args.what)
    print(f"{args.output}: {count} {form.counts}", file=sys.stderr)
    return 0


def tum_lines(poses: Iterable[RelativePose | Track | Truth]) -> Iterator[str]:
    """Yield `t x y z qx qy qz qw` of T_a_b by time."""
    for pose in sorted(poses, key=lambda pose: pose.stamp_ns):
        yield tum_line(pose.stamp_ns, pose.t_a_b_m, pose.q_a_b_xyzw)


def _csv_row(result: RelativePose | Rejected, truth: TruthTrack) -> dict[str, object]:
    row: dict[str, object] = {
        name: getattr(result, name)
        for name in ("stamp_ns", "trigger", "node_a", "node_b", *_REASON_FIELDS)
        if hasattr(result, name)
    }
    if isinstance(result, Rejected):
        return row
    row |= _place(result) | _true(truth.at(result.stamp_ns, result.trigger))
    row |= {
        name: getattr(result, name)
        for name in ("range_gap_m", "twist_gap_rad", "chi2", "hypotheses", "method", "skew_ns")
    }
    row["heading_gap_rad"] = "" if result.heading_gap_rad is UNSET else result.heading_gap_rad
    row["checks"] = " ".join(result.checks)
    return row | {f"cov_{_AXES[i]}_{_AXES[k]}": result.covariance[6 * i + k] for i, k in _UPPER}


def _true(truth: tuple[Floats, Floats] | None) -> dict[str, object]:
    """Return the columns of the true t_a_b_m (3,) and q_a_b_xyzw (4,), if they are known."""
    return {} if truth is None else dict(zip(_TRUTH_FIELDS, np.concatenate(truth).tolist(), strict=True))


def _track_csv_row(one: Track, truth: TruthTrack) -> dict[str, object]:
    row: dict[str, object] = {name: getattr(one, name) for name in ("stamp_ns", "node_a", "node_b", "mode")}
    row |= _place(one) | {"lights": one.lights, "age_s": one.age_s} | _true(truth.interpolated(one.stamp_ns))
    row |= dict(zip(("v_a_b_x_mps", "v_a_b_y_mps", "v_a_b_z_mps"), one.v_a_b_mps, strict=True))
    for i, k in _UPPER:
        row[f"cov_{_AXES[i]}_{_AXES[k]}"] = one.covariance[6 * i + k]
        if k < 3:
            row[f"cov_v{_AXES[i]}_v{_AXES[k]}"] = one.v_covariance[3 * i + k]
    return row


def _place(result: RelativePose | Track) -> dict[str, object]:
    """Return the columns that poses and tracks share: B's place and its sigmas; unknown values are left out."""
    row: dict[str, object] = dict(zip(_PLACE_FIELDS[:7], (*result.t_a_b_m, *result.q_a_b_xyzw), strict=True))
    variances = result.covariance[::7]
    row |= {name: math.sqrt(v) if v >= 0.0 else "" for name, v in zip(_SD_FIELDS, variances, strict=True)}
    row["range_m"] = result.range_m
    if result.t_ned_m is not UNSET:
        row |= dict(zip(("t_ned_north_m", "t_ned_east_m", "t_ned_down_m"), result.t_ned_m, strict=True))
    if result.sigma_ned_m is not UNSET:
        row |= dict(zip(("sd_ned_north_m", "sd_ned_east_m", "sd_ned_down_m"), result.sigma_ned_m, strict=True))
    angles = {
        "azimuth_rad": result.azimuth_rad,
        "inclination_rad": result.inclination_rad,
        "sd_azimuth_rad": result.sigma_azimuth_rad,
        "sd_inclination_rad": result.sigma_inclination_rad,
    }
    return row | {name: value for name, value in angles.items() if value is not UNSET}
