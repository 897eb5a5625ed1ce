"""All clients that show messages or pass them on, without a bus: each takes what its door lets in."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable

import msgspec
import numpy as np
from buddyline.protocol.bus import Received
from buddyline.protocol.clock import ManualClock
from buddyline.protocol.codec import encode
from buddyline.protocol.envelope import Envelope, Refusals
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import Candidates, Message, Rejected, RelativePose, Truth
from buddyline.protocol.topics import TRUTH, key_of
from buddyline.tools.bridge.http_api import Answers
from buddyline.tools.bridge.mavlink import KINDS, MavlinkTranslation
from buddyline.tools.bridge.nmea import sentences
from buddyline.tools.bridge.place import on_earth, parse_place
from buddyline.tools.bridge.placed import Placing
from buddyline.tools.export.ros_messages import Translation
from buddyline.tools.monitor.frames import Viewer, fields
from buddyline.tools.monitor.overview import Overview
from buddyline.tools.survey.live import Watch
from hypothesis import strategies as st

from tests.fuzz.samples import SOUND, STAMP_NS
from tests.fuzz.targets import TARGETS, Capture, extreme, ros_types, spoilt_payloads

AT_MOST = 24
PATHS = ("acoustic/filtered", "global", "master")


@st.composite
def told(draw: st.DrawFn) -> list[Received]:
    """What comes on a bus in some seconds: sound, with absurd numbers, or spoilt; at any time, of three nodes."""
    came = []
    for number in range(draw(st.integers(1, AT_MOST))):
        message = draw(st.sampled_from(SOUND))
        settable = message.__struct_fields__
        if "stamp_ns" in settable:
            later_ns = draw(
                st.sampled_from([0, number, number, number, 40, -(2**34), 10**9]) | st.integers(-(10**10), 10**10)
            )
            stamp_ns = max(STAMP_NS + 10**8 * later_ns, 0)
            message = msgspec.structs.replace(message, stamp_ns=min(stamp_ns, 2**62))
        if isinstance(message, Candidates | RelativePose | Rejected):
            message = msgspec.structs.replace(message, trigger=message.trigger + number)
        node = draw(st.sampled_from("aabc"))
        if "node" in settable:
            message = msgspec.structs.replace(message, node=node)
        payload = draw(st.one_of(st.just(encode(message)), extreme(message), spoilt_payloads(message)))
        came.append(Received(_key(message), payload, STAMP_NS + number * 10**8, ""))
    return came


def _key(message: Message) -> str:
    return TRUTH.key("a", "b") if isinstance(message, Truth) else key_of(message)


def _bridge() -> Callable[[Envelope], None]:
    """What `bridge` does with a message, with everything that it can send, but for the sockets."""
    clock, place = ManualClock(STAMP_NS), parse_place("47.6,9.4")
    state, placings = Answers(clock.now_ns), [Placing("b"), Placing("a", net="main")]
    translation = MavlinkTranslation(tuple(KINDS), 1)

    def take(envelope: Envelope) -> None:
        state.take(envelope)
        for placing in placings:
            placed = placing.take(envelope)
            if placed is None:
                continue
            for one, earth in (
                (placed, None),
                (placed.with_true_north(0.1), on_earth(placed.with_true_north(0.1), place)),
            ):
                assert all(isinstance(packet, bytes) for packet in translation.packets(one, earth))
                "".join(sentences(one, earth)).encode("ascii")
                state.place(one, earth, place)
        for path in PATHS:
            msgspec.json.encode(state.answer(f"/api/v1/position/{path}"))

    return take


def _monitor() -> Callable[[Envelope], None]:
    overview, viewer = Overview(), Viewer(live=True)

    def take(envelope: Envelope) -> None:
        overview.take(envelope)
        viewer.choose_fields(fields(overview)[:3])
        msgspec.json.encode(viewer.frame(overview, envelope.time_ns))

    return take


def _ros() -> Callable[[Envelope], None]:
    store = ros_types()
    translation = Translation(store.types)

    def take(envelope: Envelope) -> None:
        with contextlib.suppress(MessageError):
            for one in translation.messages(envelope.message):
                store.serialize_cdr(one.value, one.type_name)

    return take


def _survey() -> Callable[[Envelope], None]:
    return Watch(Capture(), Refusals("survey watch"))._take


CLIENTS = {"bridge": _bridge, "monitor": _monitor, "ros2": _ros, "survey watch": _survey}


def fuzz_clients(data: st.DataObject) -> None:
    """Every client takes it all."""
    refusals = Refusals("fuzz")
    opened = [envelope for received in data.draw(told()) if (envelope := refusals.open(received)) is not None]
    # numpy warns of such numbers; in the tests warnings would be errors.
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for begin in CLIENTS.values():
            take = begin()
            for envelope in opened:
                take(envelope)


ALL_TARGETS = {**TARGETS, "clients": fuzz_clients}
