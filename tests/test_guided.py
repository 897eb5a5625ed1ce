"""From the solver to the node over Zenoh: the track foretells the lights, and the node is told where to look."""

import threading
import time

from buddyline.node.guide import Guide
from buddyline.protocol.clock import ManualClock
from buddyline.protocol.codec import encode
from buddyline.protocol.messages import Candidates
from buddyline.protocol.topics import EXPECT, key_of, parse_key
from buddyline.protocol.zenoh_bus import connect
from buddyline.protocol.zenoh_bus.hub import open_hub
from buddyline.solver_service.config import SolverConfig
from buddyline.solver_service.service import SolverService

from tests.processes import PATIENCE_S, free_endpoint
from tests.solver_service.conftest import PERIOD_NS, dive_messages


def join(endpoint):
    bus = connect(endpoint, stop=threading.Event(), on_wait=lambda _: None)
    assert bus is not None
    return bus


def until(condition):
    deadline_s, pause = time.monotonic() + PATIENCE_S, threading.Event()
    while not condition():
        assert time.monotonic() < deadline_s, "it did not come"
        pause.wait(0.01)


class Told(Guide):
    """A guide that lets a test wait for what it is told."""

    def __init__(self, node):
        super().__init__(node)
        self.stamps_ns = set()
        self.changed = threading.Condition()

    def expect(self, message):
        super().expect(message)
        with self.changed:
            self.stamps_ns.add(message.stamp_ns)
            self.changed.notify_all()

    def wait_for(self, stamp_ns):
        with self.changed:
            return self.changed.wait_for(lambda: stamp_ns in self.stamps_ns, PATIENCE_S)


def test_a_node_hears_where_its_next_picture_shows_the_lights():
    messages, world = dive_messages(seconds=3.0, imu=True)
    endpoint = free_endpoint()
    with open_hub(endpoint), join(endpoint) as nodes, join(endpoint) as own:
        service = SolverService(SolverConfig(nodes=["a", "b"]), clock=ManualClock(messages[0].stamp_ns))
        with join(endpoint) as solvers:
            guides = {node: Told(node) for node in ("a", "b")}
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

            # Keys overtake each other: what the last frames are solved with has to be there before them.
            last_ns = max(message.stamp_ns for message in messages if isinstance(message, Candidates))
            last = [message for message in messages if isinstance(message, Candidates) and message.stamp_ns == last_ns]
            service.clock.set_ns(last_ns)
            for message in messages:
                if message not in last:
                    send(message)
            for node, guide in guides.items():
                assert guide.wait_for(last_ns), sorted(guide.stamps_ns)
                until(lambda node=node: (service.core.streams[node].imu.newest_ns or 0) >= last_ns)
                until(lambda node=node: (service.core.streams[node].attitude.newest_ns or 0) >= last_ns)
            for message in last:
                send(message)
            for node, guide in guides.items():
                assert guide.wait_for(last_ns + PERIOD_NS), sorted(guide.stamps_ns)
                plan = guide.plan(last_ns + PERIOD_NS, 820, 616)
                truth = world.light_truth(node, last_ns + PERIOD_NS, 0).lights
                assert len(plan.foretold) == len(truth) == 2
                for place in plan.foretold:
                    away = [((place.u_px - one.u_px) ** 2 + (place.v_px - one.v_px) ** 2) ** 0.5 for one in truth]
                    assert min(away) < place.radius_px < 50.0
                assert guide.refusals.count == 0
            # It takes its turn behind the last message's results, which are then out.
            service.report()
