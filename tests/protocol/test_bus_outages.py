"""A hub that is killed, stands still or is cut off: what was said meanwhile comes, or is counted."""

from __future__ import annotations

import itertools
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
from buddyline.protocol.connection import Connection
from buddyline.protocol.service import JOIN_TIMEOUT_S
from buddyline.protocol.zenoh_bus import watchdog
from buddyline.protocol.zenoh_bus.session import RETRY_S, config_of
from buddyline.protocol.zenoh_bus.settings import client_settings

from tests.processes import PATIENCE_S, free_endpoint, until
from tests.protocol.buses import numbers, run_client
from tests.protocol.inbox import Inbox

HUB = """
import sys
from buddyline.protocol.zenoh_bus import open_hub
with open_hub(sys.argv[1]):
    print("listening", flush=True)
    sys.stdin.readline()
"""


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


STOPS = """
import sys, time, zenoh
from buddyline.protocol.zenoh_bus.session import config_of
from buddyline.protocol.zenoh_bus.settings import client_settings
with zenoh.open(config_of(client_settings(sys.argv[1], None))) as session:
    ring = zenoh.handlers.RingChannel(1)
    subscriber = session.declare_subscriber("buddyline/node/*/image", ring)
    print("subscribed", flush=True)
    time.sleep(1000)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="connections are found in /proc")
def test_clients_that_no_longer_read_do_not_hold_up_the_others() -> None:
    """More waits for each than its end takes. After the lease the hub closes their connections."""
    endpoint, inbox = free_endpoint(), Inbox()
    with hub_process(endpoint), run_client(endpoint) as node, run_client(endpoint) as receiver:
        receiver.subscribe("buddyline/node/*/candidates", inbox)
        publisher = node.publisher(topics.CANDIDATES, "a")
        silent = [
            subprocess.Popen([sys.executable, "-c", STOPS, endpoint], stdout=subprocess.PIPE, text=True)
            for _ in range(4)
        ]
        try:
            for client in silent:
                assert client.stdout is not None
                assert client.stdout.readline() == "subscribed\n"
                client.send_signal(signal.SIGSTOP)
            with zenoh.open(config_of(client_settings(endpoint, None))) as other:
                for _ in range(20):
                    other.put("buddyline/node/c/image", bytes(4 * 1024 * 1024))
                    time.sleep(0.05)
                sent: list[float] = []
                for number in range(100):
                    sent.append(time.monotonic())
                    publisher.put_bytes(b"%d" % number)
                    inbox.wait_until(lambda due=number + 1: len(inbox.payloads(publisher.key)) == due)  # type: ignore[misc]
                    time.sleep(0.1)
        finally:
            for client in silent:
                client.kill()
                client.communicate()
    took_s = max(b - a for a, b in itertools.pairwise(sent))
    assert took_s < 5.0
