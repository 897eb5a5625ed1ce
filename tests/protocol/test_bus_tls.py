"""The bus over TLS: who is refused and told why."""

from __future__ import annotations

import hashlib
import json
import re
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.security import RefusedError, Tls, refusal
from buddyline.protocol.zenoh_bus import connect, open_hub
from buddyline.tools.installation.init import text_of

from tests.processes import PATIENCE_S, Process, free_endpoint
from tests.tools.identities import at, copy_of, expired, join, make_keys, tls, tls_endpoint


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_keys(tmp_path_factory.mktemp("keys"), "a", "b")


@pytest.mark.parametrize(
    ("hub_is", "client_is", "says"),
    [
        ("sound", "expired", "refuses .*node-a.crt: it has expired"),
        ("sound", "foreign", "refuses .*node-a.crt: it is of another authority"),
        ("sound", "hub's own", "refuses .*hub.crt: it is not for a client"),
        ("sound", "plain", "wants TLS"),
        ("expired", "sound", "certificate of the hub at .* has expired"),
        ("foreign", "sound", "certificate of the hub at .* was not made by our authority"),
        ("a node's", "sound", "certificate of the hub at .* is not for this end"),
    ],
)
def test_a_refusal_names_the_certificate_and_the_reason(
    keys: Path, tmp_path: Path, hub_is: str, client_is: str, says: str
) -> None:
    own = copy_of(keys, tmp_path / "own")
    other = make_keys(tmp_path / "other", "a")
    sound = {"hub": tls(own, "hub"), "client": tls(own, "node-a")}
    foreign = {
        side: Tls(ca=sound["hub"].ca, certificate=t.certificate, key=t.key)
        for side, t in (("hub", tls(other, "hub")), ("client", tls(other, "node-a")))
    }
    if hub_is == "expired":
        expired(own, "hub", "127.0.0.1")
    if client_is == "expired":
        expired(own, "node-a")
    hub = {"foreign": foreign["hub"], "a node's": tls(own, "node-b")}.get(hub_is, sound["hub"])
    client = {"foreign": foreign["client"], "hub's own": tls(own, "hub"), "plain": None}.get(client_is, sound["client"])
    endpoint = free_endpoint()
    tls_there = endpoint.replace("tcp/", "tls/")
    with open_hub(tls_there, tls=hub), pytest.raises(RefusedError, match=says):
        join(endpoint if client is None else tls_there, client)


def test_endpoint_and_tls_table_must_agree(keys: Path) -> None:
    with pytest.raises(BuddylineError, match="needs a \\[tls\\] table"):
        join("tls/127.0.0.1:7447", None)
    with pytest.raises(BuddylineError, match="without TLS"):
        open_hub("tcp/127.0.0.1:7447", tls=tls(keys, "hub"))


def test_a_hub_without_tls_is_waited_for_and_the_reason_is_logged(keys: Path) -> None:
    endpoint, said, stop = free_endpoint(), [], threading.Event()

    def on_wait(text: str) -> None:
        said.append(text)
        stop.set()

    with open_hub(endpoint):
        wanted = endpoint.replace("tcp/", "tls/")
        assert connect(wanted, stop=stop, on_wait=on_wait, tls=tls(keys, "node-a")) is None
    assert len(said) == 1
    assert "no hub with TLS" in said[0]


def reset(link: socket.socket) -> None:
    link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


# An alert's record: type 21, TLS 1.2, two bytes: fatal (2), and which one.
ALERT = b"\x15\x03\x03\x00\x02\x02"


@contextmanager
def listener(endpoint: str, answer: Callable[[socket.socket], object]) -> Iterator[threading.Semaphore]:
    """Accept connections, read each one's first bytes, answer, close; the semaphore counts them."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    calls, listening = threading.Semaphore(0), socket.create_server((host, int(port)))

    def serve() -> None:
        while True:
            try:
                link, _ = listening.accept()
            except OSError:
                return
            with link:
                link.settimeout(PATIENCE_S)
                if link.recv(4096):
                    answer(link)
            calls.release()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield calls
    finally:
        listening.shutdown(socket.SHUT_RDWR)
        listening.close()
        thread.join(PATIENCE_S)


@pytest.mark.parametrize(
    "answer",
    [
        lambda _: None,
        reset,
        lambda link: link.sendall(b"\x16\x03\x03"),
        lambda link: link.sendall(b"\x10\x00" + bytes(16)),
        lambda link: link.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n"),
        lambda link: link.sendall(ALERT + b"\x50"),
        lambda link: link.sendall(ALERT + b"\x28"),
    ],
    ids=["closed", "reset", "half a record", "zenoh", "http", "alert: internal error", "alert: handshake failure"],
)
def test_only_a_rejected_certificate_ends_the_wait(keys: Path, answer: Callable[[socket.socket], object]) -> None:
    endpoint = tls_endpoint()
    with listener(endpoint, answer):
        assert refusal(endpoint, tls(keys, "node-a")) is None


def test_a_hub_that_closes_during_the_handshake_is_tried_again(keys: Path) -> None:
    endpoint, stop, joined = tls_endpoint(), threading.Event(), []

    def attempt() -> None:
        joined.append(connect(endpoint, stop=stop, on_wait=lambda _: None, tls=tls(keys, "node-a")))

    client = threading.Thread(target=attempt, daemon=True)
    try:
        with listener(endpoint, lambda _: None) as calls:
            client.start()
            for _ in range(6):
                assert calls.acquire(timeout=PATIENCE_S), "it gave up"
            assert not joined
        with open_hub(endpoint, tls=tls(keys, "hub")):
            client.join(PATIENCE_S)
            assert len(joined) == 1
            joined[0].close()
    finally:
        stop.set()
        client.join(PATIENCE_S)


def test_a_refused_node_still_records_and_reports_the_refusal(keys: Path, tmp_path: Path) -> None:
    """Processes from the files as `buddyline keys` and `init` wrote them, but for endpoint and folder."""
    own, endpoint = copy_of(keys, tmp_path / "own"), tls_endpoint()
    at(own, endpoint)
    config = own / "a.toml"
    text = text_of("node", "a", endpoint, simulated=True)
    config.write_text(re.sub(r'^directory = "[^"]*"', f'directory = "{tmp_path}/logs"', text, flags=re.MULTILINE))
    expired(own, "node-a")
    with (
        Process("hub", "--config", own / "hub.toml") as hub,
        Process("node", "--config", config) as node,
        Process("record", tmp_path / "r.mcap", "--config", own / "viewer.toml") as record,
    ):
        hub.wait_for("TLS, client certificates")
        assert "node-a.crt: has expired; recording meanwhile" in node.wait_for("not on the bus")
        record.wait_for("Ctrl-C ends")
        assert node.end() == 0
    (log,) = (tmp_path / "logs").glob("*.mcap")
    with DiveLogReader(log) as reader:
        noted = reader.metadata()
        assert not any(b"PRIVATE KEY" in record.payload for record in reader.records())
    # The log says by what configuration it was made.
    assert json.loads(noted["config"])["node"] == "a"
    assert hashlib.sha256(noted["config"].encode()).hexdigest() == noted["config_sha256"]
    assert "PRIVATE KEY" not in noted["config"]
    for process in (hub, node, record):
        assert not any("PRIVATE KEY" in line for line in process.lines)
