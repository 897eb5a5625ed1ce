"""Faults that only the bus between processes can have: a hub that is absent, in use, killed; sockets; stdout."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import zenoh
from buddyline.protocol import topics
from buddyline.protocol.bus import Bus
from buddyline.protocol.connection import Connection
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.service import JOIN_TIMEOUT_S
from buddyline.protocol.zenoh_bus import connect, open_hub, watchdog
from buddyline.protocol.zenoh_bus import hub as hub_module
from buddyline.protocol.zenoh_bus import subscription as subscription_module
from buddyline.protocol.zenoh_bus.session import RETRY_S, config_of
from buddyline.protocol.zenoh_bus.settings import client_settings

from tests.processes import PATIENCE_S, free_endpoint, until
from tests.protocol.inbox import Inbox

HUB = """
import sys
from buddyline.protocol.zenoh_bus import open_hub
with open_hub(sys.argv[1]):
    print("listening", flush=True)
    sys.stdin.readline()
"""

# What a process has open, told by itself: sockets that listen or are not TCP, and how many links to the hub.
SOCKETS = """
import json, os, sys, threading
from buddyline.protocol import topics
from buddyline.protocol.zenoh_bus import connect, open_hub

def sockets():
    links = [f"/proc/self/fd/{fd}" for fd in os.listdir("/proc/self/fd")]
    own = {os.readlink(link) for link in links if os.path.lexists(link)}
    found, links = [], 0
    for protocol in ("tcp", "tcp6", "udp", "udp6"):
        with open(f"/proc/self/net/{protocol}") as table:
            for line in list(table)[1:]:
                fields = line.split()
                if f"socket:[{fields[9]}]" not in own:
                    continue
                if protocol[:3] == "udp" or fields[3] == "0A":
                    address, port = fields[1].split(":")
                    found.append([protocol, address, int(port, 16)])
                links += fields[3] == "01"
    return found, links

role, endpoint = sys.argv[1:]
if role == "hub":
    with open_hub(endpoint):
        result = [sockets()]
else:
    with connect(endpoint, stop=threading.Event(), on_wait=print) as bus:
        bus.publisher(topics.DEPTH, "a").put_bytes(b"{}")
        bus.subscribe(topics.EVERYTHING, lambda _: None)
        bus.declare_alive("node/a")
        result = [sockets()]
        previews = bus.publisher(topics.IMAGE, "a")
        while not previews.put_bytes(b"{}"):
            pass
        result.append(sockets())
print(json.dumps(result))
"""


def run_client(endpoint: str, **more: object) -> Bus:
    bus = connect(endpoint, stop=threading.Event(), on_wait=lambda _: None, **more)  # type: ignore[arg-type]
    assert bus is not None
    return bus


def numbers(inbox: Inbox, count: int) -> list[int]:
    """Wait for so many messages; return the numbers in all."""
    return [int(received.payload) for received in inbox.wait_for(count)]


@contextmanager
def hub_process(endpoint: str) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, "-c", HUB, endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "listening\n"
            yield process
        finally:
            process.kill()


def test_a_missing_hub_is_waited_for_and_reported_once() -> None:
    endpoint, said, waiting = free_endpoint(), [], threading.Event()
    connected: list[Bus | None] = []

    def on_wait(text: str) -> None:
        said.append(text)
        waiting.set()

    thread = threading.Thread(
        target=lambda: connected.append(connect(endpoint, stop=threading.Event(), on_wait=on_wait))
    )
    thread.start()
    assert waiting.wait(PATIENCE_S)
    time.sleep(0.3)
    with open_hub(endpoint):
        thread.join(PATIENCE_S)
        (bus,) = connected
        assert bus is not None
        bus.close()
    assert len(said) == 1
    assert endpoint in said[0]


@pytest.mark.parametrize("listener", ["nobody", "someone who does not answer"])
def test_waiting_for_a_hub_ends_with_stop(listener: str) -> None:
    stop = threading.Event()
    with socket.socket() as mute:
        mute.bind(("127.0.0.1", 0))
        if listener != "nobody":
            mute.listen()
        timer = threading.Timer(0.2, stop.set)
        timer.start()
        endpoint = f"tcp/127.0.0.1:{mute.getsockname()[1]}"
        assert connect(endpoint, stop=stop, on_wait=lambda _: None) is None
        timer.join()


@pytest.mark.parametrize(
    "endpoint", ["", "localhost:7447", "tcp/7447", "udp/127.0.0.1:7447", "tcp/127.0.0.1:99999", "tcp/a b:1"]
)
def test_an_invalid_endpoint_is_refused(endpoint: str) -> None:
    with pytest.raises(BuddylineError, match="tcp/<host>:<port>"):
        connect(endpoint, stop=threading.Event(), on_wait=lambda _: None)
    with pytest.raises(BuddylineError, match="tcp/<host>:<port>"):
        open_hub(endpoint)


def test_a_port_in_use_is_reported() -> None:
    endpoint = free_endpoint()
    with open_hub(endpoint), pytest.raises(BuddylineError, match=f"{endpoint} is in use"):
        open_hub(endpoint)
    with pytest.raises(BuddylineError, match=r"192\.0\.2\.1"):
        open_hub("tcp/192.0.2.1:7447")


def test_namespaces_keep_two_systems_apart() -> None:
    one, two = Inbox(), Inbox()
    with (
        open_hub(free_endpoint()) as hub,
        run_client(hub.endpoint, namespace="dive_1") as first,
        run_client(hub.endpoint, namespace="dive_2") as second,
    ):
        first.subscribe(topics.EVERYTHING, one)
        second.subscribe(topics.EVERYTHING, two)
        first.declare_alive("node/a")
        second.publisher(topics.DEPTH, "a").put_bytes(b"2")
        first.publisher(topics.DEPTH, "a").put_bytes(b"1")
        assert (numbers(one, 1), numbers(two, 1)) == ([1], [2])
        assert one.received[0].key == "buddyline/node/a/depth"
        assert not second.is_alive("node/a")
        poses = first.publisher(topics.POSE, "a", "b")
        until(lambda: poses.put_bytes(b"3") and first.newest(topics.POSE) != [])
        assert [(r.key, r.payload) for r in first.newest(topics.POSE)] == [("buddyline/pair/a/b/pose", b"3")]
        assert second.newest(topics.POSE) == []


def test_the_hub_retains_a_bounded_number_of_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hub_module, "MAX_RETAINED", 2)
    with open_hub(free_endpoint()) as hub, run_client(hub.endpoint) as bus:
        poses = {name: bus.publisher(topics.POSE, "a", name) for name in ("x", "y", "z")}

        def held(name: str, payload: bytes) -> bool:
            poses[name].put_bytes(payload)
            return (topics.POSE.key("a", name), payload) in [(r.key, r.payload) for r in bus.newest(topics.POSE)]

        until(lambda: held("x", b"0"))
        until(lambda: held("y", b"0"))
        for _ in range(3):
            assert not held("z", b"0")
            assert not held("x", b"1" * (hub_module.MAX_RETAINED_BYTES + 1))
        until(lambda: held("x", b"2"))
        assert sorted((r.key[-6:], r.payload) for r in bus.newest(topics.POSE)) == [("x/pose", b"2"), ("y/pose", b"0")]


def test_nothing_is_lost_when_the_hub_is_killed_and_comes_back() -> None:
    """Also messages published meanwhile, and those of a publisher that was not known before."""
    endpoint, known, unheard = free_endpoint(), Inbox(), Inbox()
    changes: list[tuple[str, bool]] = []
    with hub_process(endpoint) as hub:
        node, solver = run_client(endpoint), run_client(endpoint)
        publisher = node.publisher(topics.CANDIDATES, "a")
        candidates = solver.subscribe("buddyline/node/*/candidates", known)
        depths = solver.subscribe("buddyline/node/*/depth", unheard)
        for number in range(50):
            publisher.put_bytes(b"%d" % number)
        known.wait_for(50)
        node.declare_alive("node/a")
        there, gone, back = threading.Event(), threading.Event(), threading.Event()

        def on_change(name: str, alive: bool) -> None:
            changes.append((name, alive))
            (gone if not alive else back if gone.is_set() else there).set()

        solver.watch_alive(on_change)
        assert there.wait(PATIENCE_S)
        hub.kill()
        assert gone.wait(PATIENCE_S)
        late = node.publisher(topics.DEPTH, "a")
        for number in range(50, 300):
            publisher.put_bytes(b"%d" % number)
            late.put_bytes(b"%d" % (number - 50))
    with hub_process(endpoint):
        assert numbers(known, 300) == list(range(300))
        assert numbers(unheard, 250) == list(range(250))
        assert back.wait(PATIENCE_S)
        publisher.put_bytes(b"300")
        assert numbers(known, 301)[-1] == 300
        assert (candidates.missed, candidates.dropped, depths.missed) == (0, 0, 0)
        assert changes == [("node/a", True), ("node/a", False), ("node/a", True)]
        node.close()
        solver.close()


def test_a_bus_closes_at_once_while_it_asks_a_hub_that_stands_still() -> None:
    endpoint = free_endpoint()
    with hub_process(endpoint) as hub:
        node, solver = run_client(endpoint), run_client(endpoint)
        solver.subscribe(topics.EVERYTHING, Inbox())
        for number in range(6):
            # Its first samples are missing, and nobody has them.
            declared = node._session.declare_publisher(f"buddyline/node/x{number}/candidates")
            declared.put(b"{}", source_info=zenoh.SourceInfo(declared.id, 5))
        until(lambda: sum(thread.name.startswith("bus fetch") for thread in threading.enumerate()) == 6)
        hub.send_signal(signal.SIGSTOP)
        # By then each asks again.
        time.sleep(2.0 * RETRY_S)
        begin_s = time.monotonic()
        solver.close()
        took_s = time.monotonic() - begin_s
        hub.send_signal(signal.SIGCONT)
        node.close()
    assert took_s < JOIN_TIMEOUT_S


def test_what_is_sent_again_while_there_is_no_hub_comes_to_those_who_have_missed_it() -> None:
    """It is then fetched from the publisher's cache."""
    endpoint, inbox = free_endpoint(), Inbox()
    with hub_process(endpoint) as hub:
        viewer, first, second = (run_client(endpoint) for _ in range(3))
        viewer.subscribe("buddyline/pair/*/*/rejected", inbox)
        publisher, successor = (bus.publisher(topics.REJECTED, "a", "b") for bus in (first, second))
        for number in (1, 2):
            publisher.put_bytes(b"%d" % number)
        inbox.wait_for(2)
        hub.kill()
        hub.wait(PATIENCE_S)
        first.close()
        for number in (1, 2, 3):
            successor.repeat(b"%d" % number)
        successor.put_bytes(b"4")
    with hub_process(endpoint):
        assert numbers(inbox, 4) == [1, 2, 3, 4]
        second.close()
        viewer.close()


def test_an_outage_longer_than_the_cache_is_counted() -> None:
    endpoint, inbox = free_endpoint(), Inbox()
    with hub_process(endpoint) as hub:
        node, solver = run_client(endpoint, cache_s=1.0), run_client(endpoint)
        publisher = node.publisher(topics.REJECTED, "a", "b")
        subscription = solver.subscribe("buddyline/pair/*/*/rejected", inbox)
        publisher.put_bytes(b"0")
        inbox.wait_for(1)
        hub.kill()
        hub.wait(PATIENCE_S)
        for number in range(1, 101):
            publisher.put_bytes(b"%d" % number)
    with hub_process(endpoint):
        assert numbers(inbox, 31) == [0, *range(71, 101)]
        assert subscription.missed == 70
        node.close()
        solver.close()


def test_closing_does_not_wait_for_a_hub_that_is_gone_or_frozen() -> None:
    endpoint = free_endpoint()
    for fault in (signal.SIGKILL, signal.SIGSTOP):
        with hub_process(endpoint) as hub:
            bus = run_client(endpoint)
            publisher = bus.publisher(topics.CANDIDATES, "a")
            bus.subscribe(topics.EVERYTHING, Inbox())
            bus.declare_alive("node/a")
            hub.send_signal(fault)
            for _ in range(200):
                publisher.put_bytes(b"0" * 3000)
            closer = threading.Thread(target=bus.close, daemon=True)
            closer.start()
            closer.join(PATIENCE_S)
            assert not closer.is_alive(), fault
            hub.send_signal(signal.SIGCONT)


@pytest.mark.skipif(not os.path.exists("/proc/self/fd"), reason="needs /proc")
def test_a_connection_that_receives_nothing_is_cut_and_made_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Half a connection, as Zenoh may leave it: here its other end stands still for less than the lease."""
    for name, value in (("PROBE_S", 0.3), ("PROBE_AGAIN_S", 0.2), ("PROBE_EVERY_S", 0.05)):
        monkeypatch.setattr(watchdog, name, value)
    endpoint, inbox, answers = free_endpoint(), Inbox(), []
    ask = watchdog.Watchdog._times_out

    def times_out(dog: watchdog.Watchdog, timeout_s: float) -> bool:
        answers.append(ask(dog, timeout_s))
        return answers[-1]

    monkeypatch.setattr(watchdog.Watchdog, "_times_out", times_out)
    with hub_process(endpoint) as hub, run_client(endpoint) as node, run_client(endpoint) as solver:
        # On a busy machine an answer may be late.
        until(lambda: len(answers) > 4 and not any(answers[-3:]))
        solver.subscribe("buddyline/node/*/depth", inbox)
        publisher = node.publisher(topics.DEPTH, "a")
        publisher.put_bytes(b"0")
        inbox.wait_for(1)
        hub.send_signal(signal.SIGSTOP)
        until(lambda: "has not answered" in caplog.text)
        publisher.put_bytes(b"1")
        hub.send_signal(signal.SIGCONT)
        publisher.put_bytes(b"2")
        assert numbers(inbox, 3) == [0, 1, 2]


def test_only_the_given_connection_is_cut() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = server.getsockname()
        with socket.create_connection(address) as first, socket.create_connection(address) as second:
            ends = [server.accept()[0] for _ in range(2)]
            with Connection.find(*first.getsockname()) as found:
                assert found.cut()
            assert ends[0].recv(1) == b""
            second.sendall(b"x")
            assert ends[1].recv(1) == b"x"
            for end in ends:
                end.close()
        assert Connection.find("127.0.0.1", 1) is None


@pytest.mark.skipif(not os.path.exists("/proc/self/net/tcp"), reason="needs /proc")
def test_only_the_hub_listens_and_zenoh_prints_nothing() -> None:
    endpoint = free_endpoint()
    port = int(endpoint.rpartition(":")[2])

    def sockets(role: str) -> object:
        done = subprocess.run(
            [sys.executable, "-c", SOCKETS, role, endpoint],
            check=True,
            stdout=subprocess.PIPE,
            timeout=PATIENCE_S,
            env={**os.environ, "RUST_LOG": "debug"},
        )
        return json.loads(done.stdout)

    assert sockets("hub") == [[[["tcp", "0100007F", port], ["udp", "0100007F", port]], 0]]
    with open_hub(endpoint):
        # Previews, and nothing else, have a link of their own.
        assert sockets("client") == [[[], 1], [[], 2]]


def test_lost_samples_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A foreign publisher whose numbers jump, and who cannot be asked for what is missing."""
    monkeypatch.setattr(subscription_module, "FETCHES", 2)
    inbox = Inbox()
    with open_hub(free_endpoint()) as hub, run_client(hub.endpoint) as bus:
        subscription = bus.subscribe("buddyline/node/*/depth", inbox)
        config = zenoh.Config()
        for key, value in {
            "mode": "client",
            "connect/endpoints": [hub.endpoint],
            "scouting/multicast/enabled": False,
        }.items():
            config.insert_json5(key, json.dumps(value))
        with zenoh.open(config) as foreign:

            def is_counted(key: str) -> bool:
                """Send what jumps by a new publisher. A loaded hub may drop a sample more: then it says nothing."""
                publisher, before = foreign.declare_publisher(key), subscription.missed
                until(lambda: publisher.matching_status.matching)

                def send(number: int) -> None:
                    foreign.put(key, str(number), source_info=zenoh.SourceInfo(publisher.id, number))

                for number in (0, 1, 5, 6, 6, 7):
                    send(number)
                ends_s = time.monotonic() + 3.0
                while len(inbox.payloads(key)) < 5 and time.monotonic() < ends_s:
                    time.sleep(0.01)
                send(3)
                until(lambda: foreign.put(key, "8") or b"8" in inbox.payloads(key), 0.05)
                got = [payload for payload in inbox.payloads(key) if payload != b"8"]
                return got == [b"0", b"1", b"5", b"6", b"7"] and subscription.missed == before + 3

            assert any(is_counted(f"buddyline/node/{node}/depth") for node in "abcdefgh")


@pytest.mark.parametrize("namespace", [None, "tether/two"])
def test_the_hub_passes_on_no_payload_above_its_topics_limit(namespace: str | None) -> None:
    """Whatever a client sends that is not ours: images may be larger than all else."""
    endpoint = free_endpoint()
    with open_hub(endpoint), run_client(endpoint, namespace=namespace) as receiver:
        inbox = Inbox()
        receiver.subscribe(topics.EVERYTHING, inbox)
        sender = zenoh.open(config_of(client_settings(endpoint, namespace)))
        wait = zenoh.CongestionControl.BLOCK
        image, depth = topics.IMAGE.max_bytes, topics.DEPTH.max_bytes
        sizes = {"image": [image, image + 1, 1], "depth": [depth, depth + 1, 2]}
        passed = {1, 2, depth, image}

        def heard() -> bool:
            """Send all: a publisher's first message may be missed, and a large one dropped on a full link."""
            for name, all_sizes in sizes.items():
                for size in all_sizes:
                    for key, payload in (("", b"1" * size), ("/@adv/pub/1/1/_", b"1" * (size + 1))):
                        sender.put(f"buddyline/node/a/{name}{key}", payload, congestion_control=wait)
            return {len(received.payload) for received in inbox.received} >= passed

        until(heard, 0.2)
        assert {len(received.payload) for received in inbox.received} == passed
        sender.close()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize("namespace", [None, "tether/two"])
def test_no_client_is_more_urgent_than_its_topic(namespace: str | None) -> None:
    """With BLOCK, the hub would wait for a receiver that takes nothing; all others would wait for the hub."""
    claims = {"priority": zenoh.Priority.REAL_TIME, "congestion_control": zenoh.CongestionControl.BLOCK}
    with open_hub(free_endpoint()) as hub:
        config = config_of(client_settings(hub.endpoint, namespace))
        with zenoh.open(config) as client, zenoh.open(config) as viewer:
            found: list[zenoh.Sample] = []
            viewer.declare_subscriber("buddyline/**", found.append)
            wanted = {topic.key("c") for topic in (topics.IMU, topics.CANDIDATES, topics.IMAGE)}

            def all_came() -> bool:
                for key in wanted:
                    client.put(key, b"x", express=True, **claims)
                return {str(sample.key_expr) for sample in list(found)} == wanted

            until(all_came, 0.05)
    for sample in found:
        assert sample.congestion_control == zenoh.CongestionControl.DROP
        assert sample.priority != zenoh.Priority.REAL_TIME
        assert sample.express is not str(sample.key_expr).endswith(("imu", "image"))
