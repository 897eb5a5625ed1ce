"""What one client can do at full speed with its own keys: `python -m tests.faults.attacks NAME ENDPOINT`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from itertools import count

import zenoh
from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import encode
from buddyline.protocol.messages import Blob, Candidates, Imu
from buddyline.protocol.zenoh_bus.session import config_of
from buddyline.protocol.zenoh_bus.settings import client_settings

OWN = "buddyline/node/c"


def small(session: zenoh.Session) -> Iterator[None]:
    """Small nonsense."""
    publisher = session.declare_publisher(f"{OWN}/imu")
    while True:
        publisher.put(b"x")
        yield


def large(session: zenoh.Session) -> Iterator[None]:
    """Nonsense as large as its topic allows."""
    publisher = session.declare_publisher(f"{OWN}/candidates")
    while True:
        publisher.put(b"x" * 65536)
        yield


def images(session: zenoh.Session) -> Iterator[None]:
    """Pictures as large as they may be."""
    publisher = session.declare_publisher(f"{OWN}/image")
    while True:
        publisher.put(b"x" * 4 * 1024 * 1024)
        yield


def samples(session: zenoh.Session) -> Iterator[None]:
    """Sound inertial samples."""
    publisher = session.declare_publisher(f"{OWN}/imu")
    while True:
        rest = [0.0, 0.0, 0.0]
        publisher.put(encode(Imu(node="c", stamp_ns=time.time_ns(), accel_mps2=rest, gyro_radps=rest)))
        yield


def frames(session: zenoh.Session) -> Iterator[None]:
    """Sound frames, each of another trigger, with as many lights as there may be."""
    publisher = session.declare_publisher(f"{OWN}/candidates")
    for k in count():
        stamp_ns = time.time_ns()
        lights = [
            Blob(u_px=float(i), v_px=1.0, sigma_px=0.5, area_px=9.0, peak=250.0, elongation=1.0, dt_ns=0)
            for i in range(64)
        ]
        frame = Candidates(
            node="c",
            stamp_ns=stamp_ns,
            trigger=10 * stamp_ns // S_NS + k,
            seq=k,
            boot="c",
            width_px=410,
            height_px=308,
            blobs=lights,
        )
        publisher.put(encode(frame))
        yield


def gaps(session: zenoh.Session) -> Iterator[None]:
    """Large messages of ever new publishers that have missed the ones before."""
    for _ in count():
        publisher = session.declare_publisher(f"{OWN}/candidates")
        session.put(f"{OWN}/candidates", b"x" * 60000, source_info=zenoh.SourceInfo(publisher.id, 1000))
        publisher.undeclare()  # type: ignore[no-untyped-call]
        yield


def queries(session: zenoh.Session) -> Iterator[None]:
    """Ask for everything that is held, and do not wait for the answers."""
    while True:
        session.get(
            "buddyline/**/@adv/**",
            lambda reply: None,
            target=zenoh.QueryTarget.ALL,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            priority=zenoh.Priority.REAL_TIME,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        yield
        time.sleep(0.001)


def lasts(session: zenoh.Session) -> Iterator[None]:
    """Ask for the last message of everything, and do not wait for the answers."""
    while True:
        session.get("buddyline/**", lambda reply: None, target=zenoh.QueryTarget.ALL)
        yield
        time.sleep(0.001)


def logs(session: zenoh.Session) -> Iterator[None]:
    """Ask for what nodes have in their logs."""
    for k in count():
        text = f"since=0;until={time.time_ns() - k};topics=candidates+imu"
        session.get(f"buddyline/node/*/log?{text}", lambda reply: None, target=zenoh.QueryTarget.ALL)
        yield
        time.sleep(0.001)


def subscribers(session: zenoh.Session) -> Iterator[None]:
    """Subscribe to everything, again and again, and take nothing."""
    for k in count():
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(1)
        subscriber = session.declare_subscriber("buddyline/**" if k % 3 else f"buddyline/node/c/{k}", ring)
        yield
        if k % 2:
            subscriber.undeclare()  # type: ignore[no-untyped-call]


def tokens(session: zenoh.Session) -> Iterator[None]:
    """Come and go."""
    for k in count():
        token = session.liveliness().declare_token(f"buddyline/@alive/node/c/{k}")
        yield
        if k % 2:
            token.undeclare()  # type: ignore[no-untyped-call]


def none(_session: zenoh.Session) -> Iterator[None]:
    """Do nothing."""
    while True:
        time.sleep(1.0)
        yield


def burn(_session: zenoh.Session) -> Iterator[None]:
    """Take a core of this machine, and send nothing."""
    while True:
        yield


ATTACKS: dict[str, Callable[[zenoh.Session], Iterator[None]]] = {
    one.__name__: one
    for one in (small, large, images, samples, frames, gaps, queries, lasts, logs, subscribers, tokens)
}


def main() -> None:
    """Attack until killed."""
    attack = {**ATTACKS, "none": none, "burn": burn}[sys.argv[1]]
    with zenoh.open(config_of(client_settings(sys.argv[2], None))) as session:
        for _ in attack(session):
            pass


if __name__ == "__main__":
    main()
