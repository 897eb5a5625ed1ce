"""Two underwater nodes look at each other's lights; a closed form gives their full relative pose.

For notebooks and other programs:

    import buddyline

    dive = buddyline.open_dive("a.mcap", "b.mcap")          # columns of numpy arrays
    dive.depths("a").depth_m, dive.attitudes("a").q_ned_body_xyzw
    solved = buddyline.solve("a.mcap", "b.mcap")            # in memory
    solved.poses.t_a_b_m, solved.track.t_a_b_m, solved.rejections.reason
    blobs = buddyline.detect(picture)                       # of an image array
    info = buddyline.read_info("a.mcap")                    # calibration
    with buddyline.live_poses() as poses:                   # as the solver finds them
        for pose in poses:
            print(pose.range_m)

Whatever goes wrong with a file, a value or the hub is a BuddylineError that names it. Nothing heavy is imported before
it is called. All other modules may change without notice.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from buddyline.protocol.errors import BuddylineError
    from buddyline.protocol.messages import (
        Attitude,
        Blob,
        CameraModel,
        Candidates,
        Depth,
        Imu,
        Message,
        NodeInfo,
        Rejected,
        RelativePose,
        Track,
        Truth,
    )
    from buddyline.tools.columns import (
        AttitudeColumns,
        CandidateColumns,
        DepthColumns,
        DiveColumns,
        ImuColumns,
        PoseColumns,
        RejectionColumns,
        TrackColumns,
        TruthColumns,
    )
    from buddyline.tools.livestream import LiveStream
    from buddyline.tools.offline import SolvedDive
    from numpy.typing import NDArray

__all__ = [
    "Attitude",
    "AttitudeColumns",
    "Blob",
    "BuddylineError",
    "CameraModel",
    "CandidateColumns",
    "Candidates",
    "Depth",
    "DepthColumns",
    "DiveColumns",
    "Imu",
    "ImuColumns",
    "LiveStream",
    "Message",
    "NodeInfo",
    "PoseColumns",
    "Rejected",
    "RejectionColumns",
    "RelativePose",
    "SolvedDive",
    "Track",
    "TrackColumns",
    "Truth",
    "TruthColumns",
    "__version__",
    "detect",
    "live_poses",
    "live_tracks",
    "open_dive",
    "read_info",
    "solve",
    "solve_messages",
]

ALL_CHECKS: Final = ("range", "twist", "attitude", "depth")
# Where the names live that are imported when they are asked for.
_MODULES: Final = {
    "buddyline.protocol": ("__version__",),
    "buddyline.protocol.errors": ("BuddylineError",),
    "buddyline.protocol.messages": (
        *("Attitude", "Blob", "CameraModel", "Candidates", "Depth", "Imu", "Message", "NodeInfo"),
        *("Rejected", "RelativePose", "Track", "Truth"),
    ),
    "buddyline.tools.columns": (
        *("AttitudeColumns", "CandidateColumns", "DepthColumns", "DiveColumns", "ImuColumns"),
        *("PoseColumns", "RejectionColumns", "TrackColumns", "TruthColumns"),
    ),
    "buddyline.tools.livestream": ("LiveStream",),
    "buddyline.tools.offline": ("SolvedDive",),
}
_MODULE_OF: Final = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public type when it is first asked for."""
    module = _MODULE_OF.get(name)
    if module is None:
        raise AttributeError(f"module 'buddyline' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(module), name)
    return value


def __dir__() -> list[str]:
    """List the public names."""
    return sorted(__all__)


def open_dive(*logs: str | Path) -> DiveColumns:
    """Open a stored dive: its log, or each node's own, with poses or without.

    Its methods give poses, track, attitudes, depths, candidates and truth as numpy columns, in SI units; their classes
    say shapes and frames. What can be read of damaged logs is used; `losses` says what is missing. Raises
    BuddylineError where a file is missing or is no dive log.
    """
    from buddyline.tools.columns import DiveColumns

    return DiveColumns(*logs)


def solve(
    *logs: str | Path,
    pair: tuple[str, str] | None = None,
    method: str = "refined",
    checks: Sequence[str] = ALL_CHECKS,
    clock_offset_s: float | None = None,
    environment: str = "auto",
    infos: Mapping[str, NodeInfo] | None = None,
    track: str = "smooth",
    track_hz: float = 50.0,
) -> SolvedDive:
    """Solve a stored dive in memory, as `buddyline solve` does; pictures without candidates are searched first.

    pair: (a, b) of T_a_b; may be left out where the dive has two nodes. method: "refined" (least squares from the
    closed form), "exact" (the closed form alone), or the paper's: "paper", "paper_midpoint", "paper_literal" (Damron
    et al. 2018, Eq. 1; docs/theory.md). checks: which of "range", "twist", "attitude" and "depth" may reject a pose.
    clock_offset_s: B's clock minus A's; None: what the nodes' beacons tell. environment: changes nothing for the
    default detector. infos: node id to the calibration to use in place of the logs' own. track: the fused estimate,
    "smooth" over the whole dive, "lag" or "filter" as live, "none" to save the time. track_hz: rows a second. Raises
    BuddylineError for a missing file, an unknown name or a pair that is not there.
    """
    from buddyline.tools.offline import solve_logs

    return solve_logs(
        logs,
        pair=pair,
        method=method,
        checks=checks,
        clock_offset_s=clock_offset_s,
        environment=environment,
        infos=infos,
        track=track,
        track_hz=track_hz,
    )


def solve_messages(
    messages: Iterable[Message],
    *,
    pair: tuple[str, str] | None = None,
    method: str = "refined",
    checks: Sequence[str] = ALL_CHECKS,
    clock_offset_s: float = 0.0,
    track: str = "smooth",
    track_hz: float = 50.0,
) -> SolvedDive:
    """Solve messages that a program made itself: NodeInfo and Candidates of both nodes, Imu, Attitude, Depth if any.

    The order must be that of their stamps, within a second. clock_offset_s: B's clock minus A's. The others as of
    solve. Raises BuddylineError where the pair, or a node's NodeInfo, is missing.
    """
    from buddyline.tools.offline import solve_messages as solve_in_memory

    return solve_in_memory(
        messages,
        pair=pair,
        method=method,
        checks=checks,
        clock_offset_s=clock_offset_s,
        track=track,
        track_hz=track_hz,
    )


def detect(
    image: NDArray[np.uint8], *, environment: str = "auto", method: str = "source", focal_px: float | None = None
) -> list[Blob]:
    """Find the light candidates of one picture, the likeliest first.

    image: (H, W, 3) BGR or (H, W) grey, uint8. focal_px: the camera's, which says how large lamps are; None: as of a
    picture of 49 degrees across, so give it for a crop. method: "source", "paper" or an installed detector;
    environment: the waters, for "paper" alone. A Blob's place is in px of the distorted picture, pixel centres at
    integers; its score is the probability of a lamp. Raises BuddylineError for another image, and for an unknown
    method or environment.
    """
    from buddyline.node.detect import make_detector

    return [detection.blob for detection in make_detector(method, environment, focal_px=focal_px).detect(image)]


def read_info(path: str | Path) -> NodeInfo:
    """Read a node's calibration: a NodeInfo as JSON, or the first one in a dive log.

    Raises BuddylineError where the file is missing or has none.
    """
    from buddyline.tools.dives import load_info

    return load_info(str(path))


def live_poses(
    connect: str = "",
    *,
    config: str | Path | None = None,
    pair: tuple[str, str] | None = None,
    seconds: float | None = None,
) -> LiveStream[RelativePose]:
    """Follow the solver's poses: `with live_poses() as poses: for pose in poses: ...`, until poses.stop().

    connect: the hub's endpoint, such as "tcp/192.168.2.1:7447"; default: the one on this machine. config: a TOML file
    with the hub's endpoint and [tls] (`buddyline keys viewer`). pair: (a, b); default: all. seconds: end after this
    long; default: never. Each pose is T_a_b with its covariance (protocol/README.md). Raises BuddylineError where no
    hub answers within five seconds.
    """
    from buddyline.protocol.messages import RelativePose
    from buddyline.protocol.topics import POSE
    from buddyline.tools.client import client_config_of
    from buddyline.tools.livestream import LiveStream

    return LiveStream(POSE, RelativePose, client_config_of(config, connect), ids=pair, seconds=seconds)


def live_tracks(
    connect: str = "",
    *,
    config: str | Path | None = None,
    pair: tuple[str, str] | None = None,
    seconds: float | None = None,
    lag: bool = False,
) -> LiveStream[Track]:
    """Follow the fused estimate, which goes on between poses; arguments as of live_poses.

    lag: the estimate that comes a second later and is better.
    """
    from buddyline.protocol.messages import Track
    from buddyline.protocol.topics import TRACK, TRACK_LAG
    from buddyline.tools.client import client_config_of
    from buddyline.tools.livestream import LiveStream

    return LiveStream(TRACK_LAG if lag else TRACK, Track, client_config_of(config, connect), ids=pair, seconds=seconds)
