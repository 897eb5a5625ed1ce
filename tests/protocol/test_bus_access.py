"""Who may publish what on a secured hub, and who is shut out."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh
from buddyline.protocol import topics
from buddyline.protocol.access import access_rules
from buddyline.protocol.bus import Received
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.messages import Mark
from buddyline.protocol.security import Tls
from buddyline.protocol.zenoh_bus import open_hub
from buddyline.protocol.zenoh_bus.bus import COPY
from buddyline.protocol.zenoh_bus.session import config_of
from buddyline.protocol.zenoh_bus.settings import client_settings

from tests.processes import PATIENCE_S, Process, buddyline, until
from tests.protocol.inbox import Inbox
from tests.tools.identities import at, copy_of, join, joined, make_keys, tls, tls_endpoint


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_keys(tmp_path_factory.mktemp("keys"), "a", "b")


def test_each_role_publishes_only_its_own_keys_and_all_read(keys: Path) -> None:
    endpoint = tls_endpoint()
    with (
        open_hub(endpoint, tls=tls(keys, "hub"), access=access_rules(["a", "b"])),
        joined(endpoint, keys, "node-a", "node-b", "solver", "viewer", "surveyor", "player", "viewer") as clients,
    ):
        a, b, solver, viewer, surveyor, player, watcher = clients
        inbox, alive = Inbox(), Inbox()
        watcher.subscribe(topics.EVERYTHING, inbox)
        watcher.watch_alive(lambda name, here: alive(Received(f"{name} {here}", b"", 0, "")))
        # The denied message is sent first, in one session with one priority: if it passed, it would arrive first.
        for bus, denied, allowed in (
            (a, [(topics.DEPTH, "b"), (topics.TRUTH, "a", "b"), (topics.EXPECT, "a")], (topics.DEPTH, "a")),
            (b, [(topics.CANDIDATES, "a"), (topics.POSE, "a", "b")], (topics.CANDIDATES, "b")),
            (solver, [(topics.CANDIDATES, "a")], (topics.POSE, "a", "b")),
            (solver, [], (topics.EXPECT, "b")),
            (solver, [(topics.NET_TRUTH, "main", "a")], (topics.NET_POSE, "main", "a")),
            (surveyor, [(topics.CANDIDATES, "a"), (topics.INFO, "a"), (topics.TRUTH, "a", "b")], (topics.MARK, "a")),
            (player, [(topics.POSE, "a", "b"), (topics.EXPECT, "a")], (topics.TRUTH, "a", "b")),
        ):
            for topic, *ids in [*denied, allowed]:
                assert bus.publisher(topic, *ids).put_bytes(b'{"stamp_ns":1}')
        for topic, *ids in ((topics.DEPTH, "a"), (topics.CANDIDATES, "b"), (topics.POSE, "a", "b")):
            assert viewer.publisher(topic, *ids).put_bytes(b'{"stamp_ns":2}')
        player.publisher(topics.CANDIDATES, "c").put_bytes(b'{"stamp_ns":1}')
        b.declare_alive("node/a")
        surveyor.declare_alive("node/a")
        player.declare_alive("node/a")
        viewer.declare_alive("solver/any")
        for bus, name in ((a, "node/a"), (b, "node/b"), (solver, "solver/a_b"), (viewer, "viewer/v")):
            bus.declare_alive(name)
            alive.wait_for_key(f"{name} True")
        said = [
            "buddyline/net/main/a",
            "buddyline/node/a/depth",
            "buddyline/node/a/mark",
            "buddyline/node/b/candidates",
            "buddyline/node/b/expect",
        ]
        said += ["buddyline/node/c/candidates", "buddyline/pair/a/b/pose", "buddyline/pair/a/b/truth"]
        for key in said:
            inbox.wait_for_key(key)
        # Denied messages are not in any history either; allowed ones are.
        late = Inbox()
        with join(endpoint, tls(keys, "viewer")) as latecomer:
            latecomer.subscribe(topics.EVERYTHING, late)
            for key in said:
                late.wait_for_key(key)
        assert sorted(inbox.keys) == said
        assert sorted(late.keys) == said
        assert sorted(set(alive.keys)) == [f"{n} True" for n in ("node/a", "node/b", "solver/a_b", "viewer/v")]
        # Nor does the hub retain them.
        poses, denied_poses = (bus.publisher(topics.POSE, "a", "b") for bus in (solver, viewer))
        remembered: list[Received] = []
        while not remembered:
            denied_poses.put_bytes(b'{"stamp_ns":2}')
            poses.put_bytes(b'{"stamp_ns":1}')
            remembered = viewer.newest(topics.POSE)
        assert [received.payload for received in remembered] == [b'{"stamp_ns":1}']


def test_a_node_removed_from_the_hubs_list_can_neither_publish_nor_read(keys: Path) -> None:
    endpoint = tls_endpoint()
    with (
        open_hub(endpoint, tls=tls(keys, "hub"), access=access_rules(["a"])),
        joined(endpoint, keys, "node-a", "node-b", "viewer") as (a, shut_out, viewer),
    ):
        inbox, nothing = Inbox(), Inbox()
        viewer.subscribe(topics.EVERYTHING, inbox)
        shut_out.subscribe(topics.EVERYTHING, nothing)
        for bus, node in ((shut_out, "b"), (a, "a")):
            bus.declare_alive(f"node/{node}")
            assert bus.publisher(topics.CANDIDATES, node).put_bytes(b'{"stamp_ns":1}')
        inbox.wait_for_key("buddyline/node/a/candidates")
        assert viewer.is_alive("node/a")
        assert not viewer.is_alive("node/b")
        assert not shut_out.is_alive("node/a")
        assert inbox.keys == ["buddyline/node/a/candidates"]
        # What it says itself, a session hears without the hub.
        assert nothing.keys == ["buddyline/node/b/candidates"]


def test_a_gap_is_filled_from_the_cache_under_the_access_rules(keys: Path) -> None:
    endpoint = tls_endpoint()
    with (
        open_hub(endpoint, tls=tls(keys, "hub"), access=access_rules(["a"])),
        joined(endpoint, keys, "node-a", "solver") as (a, solver),
    ):
        publisher = a.publisher(topics.CANDIDATES, "a")
        for k in range(50):
            publisher.put_bytes(b'{"stamp_ns":%d}' % k)
        received: list[bytes] = []
        done = threading.Event()

        def take(message: Received) -> None:
            received.append(message.payload)
            if len(received) == 60:
                done.set()

        solver.subscribe(topics.CANDIDATES.key_any(), take)
        for k in range(50, 60):
            publisher.put_bytes(b'{"stamp_ns":%d}' % k)
        assert done.wait(PATIENCE_S), len(received)
        assert received == [b'{"stamp_ns":%d}' % k for k in range(60)]


def raw(endpoint: str, identity: Tls) -> zenoh.Session:
    """A client that says what it likes, with a certificate of its own."""
    return zenoh.open(config_of(client_settings(endpoint, None, identity)))


def test_datagrams_have_the_same_identities_and_rules(keys: Path) -> None:
    """A put by datagram arrives on the sender's own key, and on no other's."""
    endpoint, inbox = tls_endpoint(), Inbox()
    with (
        open_hub(endpoint, tls=tls(keys, "hub"), access=access_rules(["a", "b"])),
        joined(endpoint, keys, "viewer") as (viewer,),
        zenoh.open(config_of(client_settings(endpoint, None, tls(keys, "node-a"), datagrams=True))) as session,
    ):
        viewer.subscribe(topics.EVERYTHING, inbox)
        links = session.info.links()
        assert [str(link.reliability) for link in links] == ["Reliability.BEST_EFFORT"]
        until(lambda: _said(session, inbox))
    assert {received.key for received in inbox.received} == {"buddyline/node/a/candidates"}


def _said(session: zenoh.Session, inbox: Inbox) -> bool:
    # The denied message goes first. A datagram may be lost: so both are said again.
    for node in ("b", "a"):
        session.put(f"buddyline/node/{node}/candidates", b"{}", attachment=COPY)
    return bool(inbox.received)


def source_of(session: zenoh.Session, key_expr: str, happen: Callable[[], object]) -> zenoh.SourceInfo:
    """Return what a publisher says of itself in a sample that `happen` makes it send, as often as it takes."""
    heard: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    subscriber = session.declare_subscriber(key_expr, heard.put)
    deadline_s = time.monotonic() + PATIENCE_S
    while heard.empty():
        assert time.monotonic() < deadline_s
        happen()
        time.sleep(0.05)
    info = heard.get().source_info
    subscriber.undeclare()  # type: ignore[no-untyped-call]
    assert info is not None
    return info


@pytest.mark.parametrize(
    ("role", "own"),
    [("node-a", "node/a/candidates"), ("node-a", "node/a/depth"), ("surveyor", "node/b/mark")],
)
def test_nobody_can_mute_another_by_stating_its_source(keys: Path, role: str, own: str) -> None:
    """The forger has heard b; on keys of its own it goes on in b's name, by puts, heartbeats and recovery answers."""
    endpoint = tls_endpoint()
    with (
        open_hub(endpoint, tls=tls(keys, "hub"), access=access_rules(["a", "b"])),
        joined(endpoint, keys, "node-b", "solver", "viewer") as (b, solver, recorder),
    ):
        forger = raw(endpoint, tls(keys, role))
        everything, candidates = Inbox(), Inbox()
        recorder.subscribe(topics.EVERYTHING, everything)
        solver.subscribe(topics.CANDIDATES.key_any(), candidates)
        publisher = b.publisher(topics.CANDIDATES, "b")
        expected: list[bytes] = []

        def say() -> None:
            expected.append(b'{"stamp_ns":%d}' % len(expected))
            assert publisher.put_bytes(expected[-1])

        info = source_of(forger, "buddyline/node/b/candidates", say)
        identity = info.source_id
        beside = f"@adv/pub/{identity.zid}/{identity.eid}/_"

        def answer(query: zenoh.Query) -> None:
            for key in ("buddyline/node/b/candidates", f"buddyline/{own}"):
                query.reply(key, b'{"stamp_ns":-1}')

        for key in (f"buddyline/{own}/{beside}", f"buddyline/node/b/candidates/{beside}", "buddyline/**/@adv/**"):
            forger.declare_queryable(key, answer)
        for key in (f"buddyline/{own}", "buddyline/node/b/candidates"):
            for number in (1, 2, 50, 10**6, 2**31):
                forger.put(key, b'{"stamp_ns":-1}', source_info=zenoh.SourceInfo(identity, number))
            for number in (60, 10**6):
                forger.put(f"{key}/{beside}", number.to_bytes(4, "little"))
            forger.delete(key, source_info=zenoh.SourceInfo(identity, 70))
        # The forger's words have arrived when a last one without a number has.
        forger.put(f"buddyline/{own}", b'{"stamp_ns":-2}')
        everything.wait_for_key(f"buddyline/{own}")
        for _ in range(100):
            say()
        for inbox in (everything, candidates):
            inbox.wait_until(lambda: expected[-1] in inbox.payloads("buddyline/node/b/candidates"))  # noqa: B023
            assert inbox.payloads("buddyline/node/b/candidates") == expected
        forger.close()  # type: ignore[no-untyped-call]


# The table in protocol/README.md: what each role may publish, of the keys below.
OWN_KEYS: dict[str, Callable[[str], bool]] = {
    "node-a": lambda key: key.startswith("node/a/") and not key.endswith("/expect"),
    "solver": lambda key: key.startswith("pair/a/b/") or key in ("net/main/a", "net/main/b") or key.endswith("/expect"),
    "viewer": lambda _: False,
    "surveyor": lambda key: key.startswith("node/") and key.endswith("/mark"),
    "player": lambda key: (
        (key.startswith("node/") and not key.endswith(("/expect", "/log")))
        or key in ("pair/a/b/truth", "pair/a/b/artag", "net/main/truth/a", "net/main/truth/b")
    ),
    "ros2": lambda _: False,
}
ALIVE_AS = {"node-a": "node/a", "solver": "solver", "viewer": "viewer", "surveyor": "surveyor", "player": "player"}


@pytest.mark.parametrize("role", OWN_KEYS)
def test_no_role_gets_anything_onto_another_s_keys(keys: Path, role: str) -> None:
    """Every role, every key: puts, deletes, heartbeats, answers and tokens in another's name."""
    templates = [topics.LOG, *(topic.template for topic in topics.TOPICS)]
    every = {
        template.format(node=node, a="a", b="b", net="main").removeprefix("buddyline/")
        for template in templates
        for node in "ab"
    }
    own = {key for key in every if OWN_KEYS[role](key)}
    strange = ["buddyline/any", "any", "x/buddyline/node/b/candidates", "buddyline/node/b/candidates/more"]
    endpoint = tls_endpoint()
    with (
        open_hub(endpoint, tls=tls(keys, "hub"), access=access_rules(["a", "b"])),
        raw(endpoint, tls(keys, "viewer")) as watcher,
        raw(endpoint, tls(keys, role)) as client,
    ):
        heard: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        alive: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        watched = [watcher.declare_subscriber(f"buddyline/{end}", heard.put) for end in ("**", "**/@adv/**")]
        watched.append(watcher.liveliness().declare_subscriber("buddyline/@alive/**", alive.put))
        foreign = [f"buddyline/{key}" for key in sorted(every - own)] + strange
        mine = [f"buddyline/{key}" for key in sorted(own)]
        beside = f"@adv/pub/{watcher.zid()}/1/_"

        def answer(query: zenoh.Query) -> None:
            for key in (*foreign, *mine):
                query.reply(key, b"answer")
                query.reply(f"{key}/{beside}", b"answer")

        # Foreign ones first: of one session, if they passed, they would arrive first.
        kept: list[object] = []
        for key in (*foreign, *mine):
            client.put(key, b"x")
            client.put(key, b"x", source_info=zenoh.SourceInfo(client.declare_publisher(key).id, 1000))
            client.delete(key)
            client.put(f"{key}/{beside}", (9).to_bytes(4, "little"))
            kept += [client.declare_queryable(key, answer), client.declare_queryable(f"{key}/{beside}", answer)]
        kept.append(client.declare_queryable("buddyline/**", answer))
        tokens = [f"buddyline/@alive/{name}/z" for name in (*ALIVE_AS.values(), "node/b") if name != ALIVE_AS.get(role)]
        kept += [client.liveliness().declare_token(token) for token in tokens]
        expected = {*mine, *(f"{key}/{beside}" for key in mine)}
        said: set[str] = set()
        while said < expected:
            said.add(str(heard.get(timeout=PATIENCE_S).key_expr))
        if role in ALIVE_AS:
            token = f"buddyline/@alive/{ALIVE_AS[role]}/z"
            kept.append(client.liveliness().declare_token(token))
            assert str(alive.get(timeout=PATIENCE_S).key_expr) == token
        # A question and its answers go the whole way after all that was said.
        answered = {
            str(reply.ok.key_expr)
            for end in ("**", "**/@adv/**")
            for reply in watcher.get(
                f"buddyline/{end}", target=zenoh.QueryTarget.ALL, accept_replies=zenoh.ReplyKeyExpr.ANY
            )
            if reply.ok is not None
        }
        while not heard.empty():
            said.add(str(heard.get().key_expr))
        assert said == expected
        # Before its own token goes, which is said, too.
        assert alive.empty()
        del watched, kept
        assert answered <= expected
        assert bool(answered) == bool(mine)


def test_marks_and_stored_dives_reach_a_secured_hub_with_the_right_certificate_alone(
    keys: Path, tmp_path: Path
) -> None:
    own = copy_of(keys, tmp_path / "own")
    endpoint = at(own, tls_endpoint())
    mark = Mark(node="a", stamp_ns=5, kind="note", name="", note="from the dive")
    with DiveLogWriter(tmp_path / "dive.mcap") as writer:
        writer.write_message(mark)
    with (
        Process("hub", "--config", own / "hub.toml") as hub,
        Process("record", tmp_path / "r.mcap", "--config", own / "viewer.toml") as record,
    ):
        hub.wait_for("TLS, client certificates")
        record.wait_for("Ctrl-C ends")
        words = ("mark", "T4", "--node", "b", "--config")
        for command, refused, role in (
            (words, "viewer", "surveyor"),
            (("play", tmp_path / "dive.mcap", "--config"), "surveyor", "player"),
        ):
            done = buddyline(*command, own / f"{refused}.toml")
            assert done.returncode == 2
            assert f"{refused}.crt: is the certificate of {refused!r}, and {role!r} is needed here" in done.stderr
            done = buddyline(*command, own / f"{role}.toml")
            assert done.returncode == 0, done.stderr
        plain = buddyline("mark", "T5", "--node", "b", "--connect", endpoint.replace("tls/", "tcp/"))
        assert (plain.returncode, "wants TLS" in plain.stderr) == (2, True)
        assert record.end() == 0
    with DiveLogReader(tmp_path / "r.mcap") as reader:
        marks = [record.open().message for record in reader.records(lambda key: key.endswith("/mark"))]
    assert [(m.node, m.name or m.note) for m in marks] == [("b", "T4"), ("a", "from the dive")]


def test_who_is_taken_off_the_list_is_out_without_a_restart(keys: Path, tmp_path: Path) -> None:
    """The hub looks at its configuration; whoever stays comes back by itself and loses nothing."""
    own = copy_of(keys, tmp_path / "own")
    endpoint, config = at(own, tls_endpoint()), own / "hub.toml"
    text = config.read_text()
    with Process("hub", "--config", config) as hub:
        hub.wait_for("listens")
        with joined(endpoint, keys, "node-a", "node-b", "solver", "viewer") as (a, b, solver, viewer):
            inbox, shut_out = Inbox(), Inbox()
            solver.subscribe(topics.EVERYTHING, inbox)
            viewer.subscribe(topics.EVERYTHING, shut_out)
            depths = {node: bus.publisher(topics.DEPTH, node) for node, bus in (("a", a), ("b", b))}
            for node in "ab":
                depths[node].put_bytes(b'{"stamp_ns":0}')
                inbox.wait_for_key(f"buddyline/node/{node}/depth")
                shut_out.wait_for_key(f"buddyline/node/{node}/depth")
            config.write_text(text.replace('nodes = ["a", "b"]', 'nodes = ["a"]\nshut_out = ["viewer"]'))
            hub.wait_for("shut out: viewer")
            # A file that is not valid changes nothing.
            config.write_text("nodes = 3")
            hub.wait_for("stays as it was")
            for k in range(1, 50):
                for node in "ab":
                    depths[node].put_bytes(b'{"stamp_ns":%d}' % k)
            expected = [b'{"stamp_ns":%d}' % k for k in range(50)]
            inbox.wait_until(lambda: len(inbox.payloads("buddyline/node/a/depth")) >= len(expected))
            assert inbox.payloads("buddyline/node/a/depth") == expected
            assert inbox.payloads("buddyline/node/b/depth") == expected[:1]
            assert shut_out.payloads("buddyline/node/a/depth") == expected[:1]
            config.write_text(text)
            hub.wait_for("nodes that may publish: a, b")
            depths["b"].put_bytes(b'{"stamp_ns":50}')
            inbox.wait_until(lambda: b'{"stamp_ns":50}' in inbox.payloads("buddyline/node/b/depth"))
