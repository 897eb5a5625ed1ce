"""What only the bus between processes has: a hub that is absent or in use, namespaces, sockets, limits at the hub."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
import time

import pytest
import zenoh
from buddyline.protocol import topics
from buddyline.protocol.bus import Bus
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.zenoh_bus import connect, open_hub
from buddyline.protocol.zenoh_bus import hub as hub_module
from buddyline.protocol.zenoh_bus import subscription as subscription_module
from buddyline.protocol.zenoh_bus.session import config_of
from buddyline.protocol.zenoh_bus.settings import client_settings

from tests.processes import PATIENCE_S, free_endpoint, until
from tests.protocol.buses import numbers, run_client
from tests.protocol.inbox import Inbox

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
