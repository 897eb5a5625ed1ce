"""From the solver to the node over Zenoh: the track foretells the lights, and the node is told where to look."""

import threading

from buddyline.node.guide import Guide
from buddyline.protocol.clock import ManualClock
from buddyline.protocol.codec import encode
from buddyline.protocol.messages import Candidates, NodeInfo
from buddyline.protocol.topics import EXPECT, key_of, parse_key
from buddyline.protocol.zenoh_bus import connect
from buddyline.protocol.zenoh_bus.hub import open_hub
from buddyline.solver_service.config import SolverConfig
from buddyline.solver_service.service import SolverService

from tests.processes import free_endpoint, until
from tests.solver_service.conftest import dive_messages


def join(endpoint):
    bus = connect(endpoint, stop=threading.Event(), on_wait=lambda _: None)
    assert bus is not None
    return bus


def newest_ns(service, node, sensor):
    stream = service.core.streams.get(node)
    return (stream and getattr(stream, sensor).newest_ns) or 0


def is_calibrated(service, node):
    stream = service.core.streams.get(node)
    return stream is not None and stream.calibration(0) is not None


class GuideTold(Guide):
    """A guide that remembers what it is told of."""

    def __init__(self, node):
        super().__init__(node)
        self.stamps_ns = set()

    def expect(self, message):
        super().expect(message)
        self.stamps_ns.add(message.stamp_ns)


def test_a_node_hears_where_its_next_picture_shows_the_lights():
    messages, world = dive_messages(seconds=3.0, imu=True)
    endpoint = free_endpoint()
    with open_hub(endpoint), join(endpoint) as nodes, join(endpoint) as own:
        service = SolverService(SolverConfig(nodes=["a", "b"]), clock=ManualClock(messages[0].stamp_ns))
        with join(endpoint) as solvers:
            guides = {node: GuideTold(node) for node in ("a", "b")}
            for node, guide in guides.items():
                own.subscribe(EXPECT.key(node), guide.hear, history=False)
            own.watch_alive(guides["a"].saw_process)
            service.attach(solvers)
            solvers.declare_alive("solver/a_b")
            publishers = {}

            def send(message):
                key = key_of(message)
                if key not in publishers:
                    topic, ids = parse_key(key)
                    publishers[key] = nodes.publisher(topic, *ids)
                publishers[key].put_bytes(encode(message))

            # Keys overtake each other: what the frames are solved with has to be there before them.
            frames = [message for message in messages if isinstance(message, Candidates)]
            last_ns = max(frame.stamp_ns for frame in frames)
            service.clock.set_ns(last_ns)
            for message in messages:
                if not isinstance(message, Candidates):
                    send(message)
            for info in (message for message in messages if isinstance(message, NodeInfo)):
                # What is put before the subscriber knows of the publisher may be lost.
                until(lambda info=info: is_calibrated(service, info.node) or send(info))
            for node in guides:
                for sensor in ("imu", "attitude", "depth"):
                    until(lambda node=node, sensor=sensor: newest_ns(service, node, sensor) >= last_ns)
            for i, frame in enumerate(frames):
                send(frame)
                until(lambda due=i + 1: sum(stream.received for stream in service.core.streams.values()) >= due)
            for node, guide in guides.items():
                # Of so many, one or two may be dropped on a busy machine.
                until(lambda guide=guide: len(guide.stamps_ns) >= 10)
                stamp_ns = max(guide.stamps_ns)
                plan = guide.plan(stamp_ns, 820, 616)
                truth = world.light_truth(node, stamp_ns, 0).lights
                assert len(plan.foretold) == len(truth) == 2
                for place in plan.foretold:
                    away = [((place.u_px - one.u_px) ** 2 + (place.v_px - one.v_px) ** 2) ** 0.5 for one in truth]
                    assert min(away) < place.radius_px < 50.0
                assert guide.refusals.count == 0
            # It takes its turn behind the last message's results, which are then out.
            service.report()
