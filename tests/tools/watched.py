"""A pair as it is watched, for the tests of monitor, view and report."""

from __future__ import annotations

from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import encode
from buddyline.protocol.envelope import open_envelope
from buddyline.protocol.messages import (
    Attitude,
    CompressedImage,
    Depth,
    FoxgloveTime,
    Message,
    NodeStatus,
    SolverStatus,
)
from buddyline.protocol.topics import key_of
from buddyline.tools.health.pair import findings
from buddyline.tools.health.words import sentence
from buddyline.tools.monitor.picture import PairPicture
from msgspec import UNSET, UnsetType

from tests.tools.evaluated import FIRST, INFOS, PERIOD_NS, frame, pose

START_NS = FIRST * PERIOD_NS
# The smallest picture a browser takes: one grey pixel.
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010800000000"
    "3a7e9b550000000a49444154081d6368000000820081f0aae3220000000049454e44ae426082"
)


def attitude(node: str, stamp_ns: int, q_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)) -> Attitude:
    return Attitude(node=node, stamp_ns=stamp_ns, q_ned_body_xyzw=q_xyzw, sigma_rad=(0.01, 0.01, 0.05))


def depth(node: str, stamp_ns: int, depth_m: float = 12.5) -> Depth:
    return Depth(node=node, stamp_ns=stamp_ns, depth_m=depth_m, sigma_m=0.02)


def status(node: str, stamp_ns: int, problem: str = "") -> NodeStatus:
    return NodeStatus(
        node=node,
        stamp_ns=stamp_ns,
        boot="t",
        software="buddyline test",
        uptime_s=100.0,
        rates_hz={"candidates": 10.0},
        drops={"frame": 0},
        ages_s={},
        problem=problem,
    )


def solver_status(stamp_ns: int, problem: str = "", advice: list[str] | UnsetType = UNSET) -> SolverStatus:
    return SolverStatus(
        node_a="a",
        node_b="b",
        stamp_ns=stamp_ns,
        software="buddyline test",
        received_a=1,
        received_b=1,
        matched=1,
        solved=1,
        rejected={},
        late=0,
        duplicates=0,
        bad_messages=0,
        pending=0,
        problem=problem,
        advice=advice,
    )


def image(node: str, stamp_ns: int, format_: str = "png") -> CompressedImage:
    time = FoxgloveTime(sec=stamp_ns // S_NS, nsec=stamp_ns % S_NS)
    return CompressedImage(timestamp=time, frame_id=f"{node}_camera", data=PNG, format=format_)


def at(k: int) -> int:
    """The instant of trigger k."""
    return START_NS + k * PERIOD_NS


def tick(k: int, nodes: str = "ab") -> list[Message]:
    """All that a healthy pair says at trigger k, of these nodes."""
    said: list[Message] = []
    for node in nodes:
        said += [attitude(node, at(k)), depth(node, at(k)), frame(node, k)]
        if k % 10 == 0:
            said.append(status(node, at(k)))
    if nodes == "ab":
        said.append(pose(k))
    if k % 10 == 0:
        said.append(solver_status(at(k)))
    return said


def take(picture: PairPicture, message: Message, at_ns: int) -> None:
    """Let the picture take a message that came at this time."""
    picture.take(open_envelope(key_of(message), encode(message), at_ns))


def watched(ticks: int = 30) -> PairPicture:
    """A picture of a healthy pair after so many triggers, each message taken at its own stamp."""
    picture = PairPicture()
    for node in "ab":
        take(picture, INFOS[node], at(0))
    for k in range(ticks):
        feed(picture, k)
    return picture


def feed(picture: PairPicture, k: int, nodes: str = "ab") -> None:
    for message in tick(k, nodes):
        take(picture, message, at(k))


def unsolved() -> PairPicture:
    """A picture of a pair whose solver says nothing after eleven triggers."""
    picture = watched(11)
    for k in range(11, 61):
        take(picture, frame("a", k), at(k))
        take(picture, frame("b", k), at(k))
    return picture


def words(picture: PairPicture, now_ns: int, *, live: bool = True) -> str:
    """All findings as a person reads them, each with what to do."""
    return " ".join(sentence(finding, now_ns) + finding.advice for finding in findings(picture, now_ns, live=live))
