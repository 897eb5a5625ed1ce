"""The fuzzed functions: each target takes hypothesis's data, and fails if anything but a known error is raised."""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import json
import tempfile
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from buddyline.node.config import NodeConfig
from buddyline.protocol.bus import Received
from buddyline.protocol.clock import ManualClock
from buddyline.protocol.codec import decode, encode, payload_stamp_ns
from buddyline.protocol.config import Config, ConfigError, parse_config
from buddyline.protocol.digest_check import DigestCheck
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.errors import BuddylineError, MessageError
from buddyline.protocol.log_pages import Logged, Question, answer_of, pages_of
from buddyline.protocol.messages import Candidates, Message, NodeInfo, Rejected, RelativePose
from buddyline.protocol.topics import TOPICS, Topic, key_of, topic_of
from buddyline.solver_service.config import SolverConfig
from buddyline.solver_service.service import SolverService
from buddyline.tools.client import ClientConfig
from buddyline.tools.export.ros_messages import Translation, type_store
from buddyline.tools.hub import HubConfig
from buddyline.tools.repair import run as repair
from hypothesis import strategies as st

from tests.fuzz.samples import SOUND, STAMP_NS
from tests.solver_service.conftest import dive_messages

NASTY_NUMBERS = [
    0,
    1,
    -1,
    2**31,
    2**63 - 1,
    2**63,
    2**64,
    -(2**63),
    10**400,
    0.0,
    -0.0,
    0.5,
    1e-308,
    5e-324,
    1e308,
    -1e308,
]
NASTY = [
    *NASTY_NUMBERS,
    *[None, True, "", "a", "\x00", "\ud800", "é" * 50, "a" * 1000, [], {}, [[]], [0.0] * 1000, {"": None}],
    *[float("nan"), float("inf"), float("-inf")],
]
EXTREME = [0.0, -0.0, 5e-324, 1e-308, 1e-30, 1e-9, 0.5, 1.0, -1.0, 1e9, 1e30, 1e154, 1e308, -1e308]

edits = st.lists(
    st.tuples(st.sampled_from(["set", "insert", "delete", "copy", "cut"]), st.floats(0, 1), st.binary(max_size=12)),
    min_size=1,
    max_size=6,
)


def spoil(data: bytes, changes: list[tuple[str, float, bytes]]) -> bytes:
    """Apply edits to bytes; where: a share of the length."""
    for kind, where, content in changes:
        at = round(where * len(data))
        if kind == "set":
            data = data[:at] + content + data[at + len(content) :]
        elif kind == "insert":
            data = data[:at] + content + data[at:]
        elif kind == "delete":
            data = data[:at] + data[at + 1 + len(content) * 7 :]
        elif kind == "copy":
            data = data[:at] + data[at // 2 : at // 2 + 40 * len(content)] + data[at:]
        else:
            data = data[: max(at, 1)]
    return data


def _places(value: object) -> list[tuple[object, object]]:
    """Return every (container, key) of a tree of lists and objects."""
    found: list[tuple[object, object]] = []
    stack = [value]
    while stack:
        node = stack.pop()
        items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        for key, item in items:
            found.append((node, key))
            stack.append(item)
    return found


@st.composite
def spoilt_payloads(draw: st.DrawFn, message: Message) -> bytes:
    """A message with fields replaced, left out or nested deeply; or its bytes spoilt; or bytes alone."""
    payload = encode(message)
    how = draw(st.sampled_from(["fields", "bytes", "deep", "noise"]))
    if how == "bytes":
        return spoil(payload, draw(edits))
    if how == "noise":
        return draw(st.binary(max_size=200))
    tree = json.loads(payload)
    for _ in range(draw(st.integers(1, 3))):
        places = _places(tree)
        container, key = places[draw(st.integers(0, len(places) - 1))]
        if draw(st.booleans()) and isinstance(container, dict):
            del container[key]
        else:
            container[key] = copy.deepcopy(draw(st.sampled_from(NASTY)))
    text = json.dumps(tree)
    if how == "deep":
        depth = draw(st.integers(1, 20_000))
        opening = draw(st.sampled_from(["[", '{"node":', "[{"]))
        text = text[:-1] + ',"more":' + opening * depth
    return text.encode("utf-8", "surrogatepass")


def fuzz_decoders(data: st.DataObject) -> None:
    """Every decoder refuses with MessageError, or gives what can be encoded and decoded again to the same."""
    message = data.draw(st.sampled_from(SOUND))
    payload = data.draw(spoilt_payloads(message))
    payload_stamp_ns(payload)
    for topic in data.draw(st.sampled_from([TOPICS, [t for t in TOPICS if t.schema is type(message)]])):
        try:
            decoded = decode(payload, topic.schema)
        except MessageError:
            continue
        assert decode(encode(decoded), topic.schema) == decoded


@functools.cache
def _log() -> tuple[bytes, Counter[tuple[str, bytes]]]:
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "log.mcap"
        written: Counter[tuple[str, bytes]] = Counter()
        with DiveLogWriter(path, metadata={"software": "fuzz"}) as writer:
            for i in range(6):
                for message in SOUND:
                    key = "buddyline/pair/a/b/truth" if type(message).__name__ == "Truth" else key_of(message)
                    writer.write(key, encode(message), STAMP_NS + i)
                    written[key, encode(message)] += 1
                writer.flush()
        return path.read_bytes(), written


def fuzz_logs(data: st.DataObject) -> None:
    """A spoilt log gives messages that were written and no others, by time; and repair makes a sound one of it."""
    whole, written = _log()
    spoilt = spoil(whole, data.draw(edits))
    with tempfile.TemporaryDirectory() as directory:
        path, out = Path(directory) / "in.mcap", Path(directory) / "out.mcap"
        path.write_bytes(spoilt)
        with contextlib.suppress(BuddylineError), DiveLogReader(path) as reader:
            reader.metadata()
            _ = reader.keys, reader.start_ns, reader.end_ns
            _check_records(reader, written)
        try:
            with DiveLogReader(path, trust_index=False) as reader:
                kept = _check_records(reader, written)
        except BuddylineError:
            return
        with contextlib.redirect_stderr(io.StringIO()):
            assert repair(_Arguments(input=str(path), output=str(out))) == 0
        with DiveLogReader(out) as reader:
            assert reader.damage == []
            # Its parity may restore what cannot be read.
            assert _check_records(reader, written) >= kept


class _Arguments:
    def __init__(self, **values: str) -> None:
        self.__dict__.update(values)


def _check_records(reader: DiveLogReader, written: Counter[tuple[str, bytes]]) -> int:
    records = list(reader.records())
    # A payload stands in a chunk with a checksum; the key may come from a note of a channel, which has none.
    payloads = {payload for _, payload in written}
    assert all(record.payload in payloads for record in records)
    times = [record.log_time_ns for record in records]
    assert times == sorted(times)
    return len(records)


CONFIGURATIONS: tuple[tuple[type[Config], str], ...] = (
    (
        NodeConfig,
        'node = "a"\nconnect = "tcp/127.0.0.1:7447"\nrate_hz = 10.0\n[camera]\nname = "simulated"\nwidth_px = 820\n'
        "[sensors]\nmount_xyzw = [0.0, 0.0, 0.0, 1.0]\n[calibration]\nlight_left_m = [-0.4, 0.0, 0.0]\n"
        'light_right_m = [0.4, 0.0, 0.0]\n[calibration.camera]\nmodel = "pinhole"\nfx_px = 600.0\nfy_px = 600.0\n'
        'cx_px = 409.5\ncy_px = 307.5\ndistortion = [0.0, 0.0, 0.0, 0.0, 0.0]\n[tls]\nca = "a"\ncertificate = "b"\n'
        'key = "c"\n',
    ),
    (SolverConfig, 'nodes = ["a", "b"]\n[solve]\nmethod = "refined"\nchecks = ["range"]\nrange_max_m = 30.0\n'),
    (HubConfig, 'listen = "tcp/127.0.0.1:7447"\nnodes = ["a"]\n[tls]\nca = "a"\ncertificate = "b"\nkey = "c"\n'),
    (ClientConfig, 'connect = "tcp/127.0.0.1:7447"\nnamespace = "x"\n'),
)
WORDS = [
    "nan",
    "inf",
    "-1",
    "0",
    "1e400",
    "9" * 30,
    '"',
    "'''",
    "[",
    "[[x]]\n",
    "true",
    "1979-05-27",
    "\\u0000",
    "\n",
    "=",
    "{a = 1}",
]


def fuzz_configuration(data: st.DataObject) -> None:
    """A configuration loads, or is refused with an error that names its file."""
    schema, text = data.draw(st.sampled_from(CONFIGURATIONS))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text)))
        word = data.draw(st.sampled_from(WORDS) | st.text(max_size=6))
        text = text[:at] + word + text[at + data.draw(st.integers(0, 8)) :]
    try:
        config = parse_config(text, schema, "fuzz.toml")
    except ConfigError as error:
        if not str(error).startswith("fuzz.toml: "):
            raise AssertionError("the error does not name its file") from error
        return
    if isinstance(config, SolverConfig):
        with contextlib.suppress(ConfigError):
            config.solve.settings("fuzz.toml")


@functools.cache
def _dive() -> tuple[Message, ...]:
    return tuple(dive_messages(seconds=0.6, seed=7)[0])


@st.composite
def hostile_streams(draw: st.DrawFn) -> list[tuple[str, bytes]]:
    """A short dive on the nodes' keys; some messages are doubled, late, an hour ahead, or have absurd numbers."""
    stream = [(key_of(message), encode(message)) for message in _dive()]
    big = [i for i, message in enumerate(_dive()) if isinstance(message, Candidates | NodeInfo)]
    for _ in range(draw(st.integers(1, 6))):
        at = draw(st.sampled_from(big) | st.integers(0, len(_dive()) - 1))
        message = _dive()[at]
        how = draw(st.sampled_from(["extreme", "extreme", "again", "ahead"]))
        payload = encode(message)
        if how == "extreme":
            payload = draw(extreme(message))
        elif how == "ahead":
            more = {"trigger": message.trigger + 36_000} if isinstance(message, Candidates) else {}
            payload = encode(msgspec.structs.replace(message, stamp_ns=message.stamp_ns + 3_600_000_000_000, **more))
        if how == "extreme" and draw(st.booleans()):
            stream[at] = (key_of(message), payload)
        else:
            stream.append((key_of(message), payload))
            stream.insert(draw(st.integers(0, len(stream) - 1)), stream.pop())
    return stream


@st.composite
def extreme(draw: st.DrawFn, message: Message) -> bytes:
    tree = json.loads(encode(message))
    for _ in range(draw(st.integers(1, 4))):
        places = [(at, key) for at, key in _places(tree) if isinstance(at[key], float)]
        if places:
            container, key = places[draw(st.integers(0, len(places) - 1))]
            container[key] = draw(st.sampled_from(EXTREME))
    return json.dumps(tree).encode()


class Capture:
    """A bus that keeps what is published, encoded as a real one would."""

    def __init__(self) -> None:
        self.published: list[Message] = []

    def publisher(self, topic: Topic, *ids: str) -> Capture:
        return self

    def subscribe(self, *_: object, **__: object) -> None:
        """Subscribe to nothing: the test passes messages itself."""

    def newest(self, _: Topic) -> list[Received]:
        """Return no retained message."""
        return []

    def flood_problem(self) -> str:
        """Say that nobody floods it."""
        return ""

    def put(self, message: Message) -> bool:
        encode(message)
        self.published.append(message)
        return True


def fuzz_solver(data: st.DataObject) -> None:
    """The solver takes it all, and ends each trigger once."""
    service = SolverService(SolverConfig(nodes=["a", "b"]), clock=ManualClock(STAMP_NS))
    bus = Capture()
    service.attach(bus)
    sent = set()
    # numpy warns of such numbers; in the tests warnings would be errors.
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for key, payload in data.draw(hostile_streams()):
            service.receive(Received(key, payload, STAMP_NS, ""))
            with contextlib.suppress(MessageError):
                sent.add(decode(payload, Candidates).trigger)
        service._publish(service.core.flush())
    ended = Counter(result.trigger for result in bus.published if isinstance(result, RelativePose | Rejected))
    assert set(ended) <= sent
    assert all(count == 1 for count in ended.values()), ended


@functools.cache
def _translation() -> Translation:
    return Translation(ros_types().types)


@functools.cache
def ros_types() -> Any:
    return type_store()


def fuzz_ros(data: st.DataObject) -> None:
    """Whatever the bus's door lets in becomes ROS messages, or none."""
    message = data.draw(st.sampled_from(SOUND))
    with contextlib.suppress(MessageError):
        for one in _translation().messages(decode(data.draw(spoilt_payloads(message)), type(message))):
            ros_types().serialize_cdr(one.value, one.type_name)


def fuzz_digests(data: st.DataObject) -> None:
    """Digests, questions about logs and their pages are compared, answered and read, or refused."""
    check = DigestCheck(lambda *_: "not signed", must_sign=True)
    for number in range(data.draw(st.integers(1, 8))):
        message = data.draw(st.sampled_from(SOUND))
        payload = data.draw(st.one_of(st.just(encode(message)), spoilt_payloads(message)))
        key = topic_of(message).key(*["a", "b"][: len(topic_of(message).id_fields)])
        list(check.add(key, payload, STAMP_NS + number * 20_000_000_000))
    list(check.finish())
    Question.of(data.draw(st.text(max_size=200)))
    pages = list(pages_of(iter([Logged(STAMP_NS, "buddyline/node/a/imu", b"{}")])))
    with contextlib.suppress(MessageError):
        answer_of([spoil(pages[0], data.draw(edits)), *pages])


TARGETS = {
    "ros": fuzz_ros,
    "digests": fuzz_digests,
    "decoders": fuzz_decoders,
    "logs": fuzz_logs,
    "configuration": fuzz_configuration,
    "solver": fuzz_solver,
}
