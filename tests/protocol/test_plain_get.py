"""Other programs: a plain Zenoh `get`, and the program that protocol/README.md shows."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

import pytest
import zenoh
from buddyline.protocol import topics
from buddyline.protocol.access import access_rules
from buddyline.protocol.bus import Bus
from buddyline.protocol.codec import encode
from buddyline.protocol.messages import Message
from buddyline.protocol.topics import key_of, topic_of
from buddyline.protocol.zenoh_bus import connect, open_hub
from buddyline.protocol.zenoh_bus.session import config_of
from buddyline.protocol.zenoh_bus.settings import client_settings

from tests.processes import PATIENCE_S, REPOSITORY, free_endpoint, until
from tests.tools.evaluated import INFOS, pose, rejection, track
from tests.tools.identities import join, joined, make_keys, tls, tls_endpoint
from tests.tools.watched import solver_status, status

LAST: tuple[Message, ...] = (
    INFOS["a"],
    status("a", 17),
    pose(3),
    rejection(4),
    track(5),
    solver_status(18),
)


def publish_until(condition: Callable[[], object], bus: Bus, *messages: Message) -> None:
    """Publish one message of each key, again until the condition holds: the hub may miss a publisher's first."""
    sent = []
    for message in messages:
        topic = topic_of(message)
        ids = tuple(str(getattr(message, field)) for field in topic.id_fields)
        sent.append((bus.publisher(topic, *ids), message))

    def tried() -> object:
        for publisher, message in sent:
            publisher.put(message)
        return condition()

    until(tried)


def answers(session: zenoh.Session, key_expr: str) -> list[tuple[str, bytes, str]]:
    """Return all answers to a plain get, none taken out."""
    replies = session.get(key_expr, consolidation=zenoh.ConsolidationMode.NONE, timeout=PATIENCE_S)
    found = [reply.ok for reply in replies if reply.ok is not None]
    return sorted((str(one.key_expr), one.payload.to_bytes(), str(one.encoding)) for one in found)


@pytest.fixture
def endpoint() -> Iterator[str]:
    with open_hub(free_endpoint()) as hub:
        yield hub.endpoint


def client(endpoint: str, namespace: str | None = None) -> Bus:
    bus = connect(endpoint, namespace=namespace, stop=threading.Event(), on_wait=lambda _: None)
    assert bus is not None
    return bus


def plain(endpoint: str) -> zenoh.Session:
    return zenoh.open(config_of(client_settings(endpoint, None, None)))


@pytest.mark.parametrize("namespace", [None, "site"])
def test_a_plain_get_returns_the_last_message_of_every_state_once(endpoint: str, namespace: str | None) -> None:
    with client(endpoint, namespace) as bus, plain(endpoint) as session:
        root = "" if namespace is None else f"{namespace}/"
        expected = sorted((root + key_of(message), encode(message), topic_of(message).encoding) for message in LAST)
        publish_until(lambda: answers(session, f"{root}buddyline/**") == expected, bus, *LAST)
        assert answers(session, f"{root}buddyline/node/*/info") == [one for one in expected if "info" in one[0]]
        newer = status("a", 19)
        key = f"{root}buddyline/node/a/status"
        publish_until(lambda: encode(newer) in [payload for _, payload, _ in answers(session, key)], bus, newer)


def test_who_has_left_no_longer_answers_for_itself_and_the_hub_answers_with_the_last_pose(endpoint: str) -> None:
    bus = client(endpoint)
    with plain(endpoint) as session:
        publish_until(lambda: len(answers(session, "buddyline/**")) == len(LAST), bus, *LAST)
        bus.close()
        until(lambda: len(answers(session, "buddyline/**")) == 3)
        assert [key.rsplit("/", 1)[1] for key, _, _ in answers(session, "buddyline/**")] == [
            "pose",
            "rejected",
            "track",
        ]


def test_a_secured_hub_passes_the_answers_of_those_who_may_give_them(tmp_path_factory: pytest.TempPathFactory) -> None:
    keys, endpoint = make_keys(tmp_path_factory.mktemp("keys"), "a", "b"), tls_endpoint()
    with (
        open_hub(endpoint, tls=tls(keys, "hub"), access=access_rules(["a", "b"])),
        joined(endpoint, keys, "node-a", "node-b") as (a, b),
        zenoh.open(config_of(client_settings(endpoint, None, tls(keys, "viewer")))) as session,
        join(endpoint, tls(keys, "viewer")) as viewer,
    ):
        forged = encode(INFOS["a"])
        for bus in (b, viewer):
            bus.publisher(topics.INFO, "a").put_bytes(forged + b" ")
        publish_until(lambda: answers(session, "buddyline/node/a/info"), a, INFOS["a"])
        assert [payload for _, payload, _ in answers(session, "buddyline/node/a/info")] == [forged]


def test_the_readmes_python_program_prints_state_and_track(endpoint: str) -> None:
    text = (REPOSITORY / "protocol" / "README.md").read_text()
    found = re.search(r"```python\n(import json\nimport zenoh\n.*?)```", text, re.DOTALL)
    assert found is not None
    assert len([line for line in found[1].splitlines() if line]) <= 16
    program = found[1].replace("tcp/127.0.0.1:7447", endpoint)
    with client(endpoint) as bus, plain(endpoint) as session:
        publish_until(lambda: len(answers(session, "buddyline/**")) == len(LAST), bus, *LAST)
        tracks = bus.publisher(topics.TRACK, "a", "b")
        stop = threading.Event()

        def keep_on() -> None:
            while not stop.wait(0.02):
                tracks.put(track(6))

        thread = threading.Thread(target=keep_on)
        # With Python's usual buffer: its lines must come at once by the program's own doing.
        usual = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
        with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, env=usual) as child:
            try:
                lines = [child.stdout.readline() for _ in LAST]  # type: ignore[union-attr]
                assert sorted(line.split()[0] for line in lines) == sorted(key_of(message) for message in LAST)
                thread.start()
                assert child.stdout.readline() == "a b [0.0, 0.0, 3.0] 3.0\n"  # type: ignore[union-attr]
            finally:
                child.kill()
                stop.set()
                if thread.is_alive():
                    thread.join()
