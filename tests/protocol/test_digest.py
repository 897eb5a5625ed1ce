"""What a node says is summed up and signed; whatever is done to its log afterwards is named, with its second."""

from __future__ import annotations

import random
from base64 import b64decode
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from buddyline.protocol import digest_check as module
from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import encode, payload_stamp_ns
from buddyline.protocol.digest import DigestBook, sealed, unsealed
from buddyline.protocol.digest_check import LATE_NS, DigestCheck, Discrepancy
from buddyline.protocol.messages import Attitude, Depth, Digest, Message, Said
from buddyline.protocol.signing import Signer, Trust
from buddyline.protocol.topics import DIGEST, INFO, key_of, topic_of
from msgspec import UNSET

from tests.tools.evaluated import info
from tests.tools.identities import make_keys, tls

BEGAN_NS = 1_700_000_000_000_000_000
SECONDS = 6

Line = tuple[str, bytes, int]  # key, payload, log time


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_keys(tmp_path_factory.mktemp("keys"), "a", "b")


def said(node: str, at_ns: int, value: float) -> list[Message]:
    rest = (0.0, 0.0, 0.0, 1.0)
    return [
        Depth(node=node, stamp_ns=at_ns, depth_m=value, sigma_m=0.1),
        Attitude(node=node, stamp_ns=at_ns + 1, q_ned_body_xyzw=rest, sigma_rad=(0.1, 0.1, value + 1.0)),
    ]


def written(
    node: str, keys: Path | None, boot: str = "x", began_ns: int = BEGAN_NS, *, ended: bool = True
) -> list[Line]:
    """Return a node's log of some seconds: four depths and attitudes a second."""

    signer = None if keys is None else Signer.of(tls(keys, f"node-{node}"))
    book, lines = DigestBook(node, boot, began_ns), []

    def say(message: Message, at_ns: int) -> None:
        payload = encode(message)
        book.add(topic_of(message), payload_stamp_ns(payload) or 0, payload)
        lines.append((key_of(message), payload, at_ns))

    certificate = UNSET if signer is None else signer.certificate
    say(info(node=node, stamp_ns=began_ns, certificate=certificate), began_ns)
    for k in range(SECONDS * 4):
        at_ns = began_ns + k * S_NS // 4
        for message in said(node, at_ns, float(k)):
            say(message, at_ns + 2)
        if k % 4 == 3:
            digest = book.digest(at_ns + S_NS // 8, last=ended and k == SECONDS * 4 - 1)
            lines.append((key_of(digest), sealed(digest, signer and signer.sign), at_ns + S_NS // 8))
    return lines


def findings(lines: list[Line], keys: Path | None, *, own: bool = True) -> list[Discrepancy]:
    trust = Trust(keys / "ca.crt") if keys is not None else None
    check = DigestCheck(None if trust is None else trust.refuses, must_sign=trust is not None, own=own)
    return [*(one for line in lines for one in check.add(*line)), *check.finish()]


def altered(payload: bytes, rng: random.Random) -> bytes:
    """Change a digit: of a value, a stamp, a checksum, a signature or the certificate."""
    digits = [i for i, byte in enumerate(payload) if 48 <= byte <= 57]
    at = rng.choice(digits)
    return payload[:at] + (b"9" if payload[at] != 57 else b"8") + payload[at + 1 :]


def change_one(lines: list[Line], other: list[Line], rng: random.Random) -> int:
    at = rng.randrange(len(lines))
    key, payload, time_ns = lines[at]
    lines[at] = key, altered(payload, rng), time_ns
    return time_ns


def take_from_elsewhere(lines: list[Line], other: list[Line], rng: random.Random) -> int:
    """A message of another run of the same node, in the place of its own or beside it."""
    at = rng.randrange(1, len(lines))
    key, _, time_ns = lines[at]
    payload = rng.choice([one for one in other if one[0] == key])[1]
    lines[at : at + rng.randint(0, 1)] = [(key, payload, time_ns)]
    # A digest of another run tells of that one's seconds.
    return (payload_stamp_ns(payload) or 0) if key.endswith("/digest") and len(lines) > len(other) else time_ns


def take_a_second_from_elsewhere(lines: list[Line], other: list[Line], rng: random.Random) -> int:
    """A whole second of another run, with its own signed digest."""
    second = rng.randrange(SECONDS)
    lines[1 + 9 * second : 10 + 9 * second] = other[1 + 9 * second : 10 + 9 * second]
    return lines[9 + 9 * second][2]


def repeat_one(lines: list[Line], other: list[Line], rng: random.Random) -> int:
    at = rng.randrange(1, len(lines))
    to = rng.randrange(at, len(lines))
    lines.insert(to, (*lines[at][:2], lines[to][2]))
    return lines[to][2]


def drop_some(lines: list[Line], other: list[Line], rng: random.Random) -> int:
    at = rng.randrange(1, len(lines))
    time_ns = lines[at][2]
    del lines[at : at + rng.randint(1, 20)]
    return time_ns


def swap_two(lines: list[Line], other: list[Line], rng: random.Random) -> int:
    """Two neighbours of one key change places; the places keep their log times."""
    at = rng.randrange(1, len(lines))
    alike = [i for i, one in enumerate(lines) if one[0] == lines[at][0] and i != at]
    to = min(alike, key=lambda i: (abs(i - at), i))
    (key, first, at_ns), (_, second, to_ns) = lines[at], lines[to]
    lines[at], lines[to] = (key, second, at_ns), (key, first, to_ns)
    return min(at_ns, to_ns)


def strip_a_signature(lines: list[Line], other: list[Line], rng: random.Random) -> int:
    at = rng.choice([i for i, one in enumerate(lines) if one[0].endswith("/digest")])
    key, payload, time_ns = lines[at]
    lines[at] = key, unsealed(key, payload)[1], time_ns
    return time_ns


ATTACKS: tuple[Callable[[list[Line], list[Line], random.Random], int], ...] = (
    *(change_one, take_from_elsewhere, take_a_second_from_elsewhere),
    *(repeat_one, drop_some, swap_two, strip_a_signature),
)


def named(found: list[Discrepancy], at_ns: int) -> bool:
    """Whether a finding names the second in which something was done, or the end of what is known."""
    return any(one.since_ns - S_NS <= at_ns <= one.until_ns + S_NS for one in found)


def attacked(times: int, keys: Path, seed: int) -> Iterator[tuple[str, list[Discrepancy], int]]:
    rng = random.Random(seed)
    own, other = written("a", keys), written("a", keys, boot="y", began_ns=BEGAN_NS + 1000 * S_NS)
    assert not findings(own, keys)
    for _ in range(times):
        attack = rng.choice(ATTACKS)
        lines = list(own)
        at_ns = attack(lines, other, rng)
        if lines == own:  # a message was put in its own place
            continue
        yield attack.__name__, findings(lines, keys), at_ns


def test_attacks_are_named(keys: Path) -> None:
    for attack, found, at_ns in attacked(150, keys, seed=1):
        assert named(found, at_ns), (attack, at_ns - BEGAN_NS, found)


def test_a_log_without_keys_is_summed_up_all_the_same(keys: Path) -> None:
    lines = written("a", None)
    assert not findings(lines, None)
    assert {one.kind for one in findings(lines, keys)} == {"unsigned"}
    at_ns = change_one(lines, lines, random.Random(1))
    assert named(findings(lines, None), at_ns)


def test_another_nodes_key_and_another_authority_count_for_nothing(keys: Path, tmp_path: Path) -> None:
    others = make_keys(tmp_path / "others", "a")
    assert {one.kind for one in findings(written("a", others), keys)} == {"altered"}
    lines = written("a", keys)
    forged = [
        (key.replace("/a/", "/b/"), payload.replace(b'"node":"a"', b'"node":"b"'), t) for key, payload, t in lines
    ]
    assert {one.kind for one in findings(forged, keys)} == {"altered"}


def test_what_follows_a_signature_counts_for_nothing(keys: Path) -> None:
    key, digest, _ = written("a", keys)[9]
    assert unsealed(key, digest[:-1] + b',"seq":7}')[0].seq == 0
    assert not Trust(keys / "ca.crt").refuses(
        "a", Signer.of(tls(keys, "node-a")).certificate, *reversed(unsealed(key, digest)[1:])
    )


def test_a_signature_that_decodes_to_the_same_bytes_is_not_what_the_node_wrote(keys: Path) -> None:
    """Two or four bits before base64's padding count for nothing; a changed character there is named all the same."""
    # A signature has 70 to 72 bytes by chance, and padding unless it has 72.
    digests = (written("a", keys, f"x{k}")[-1] for k in range(64))
    key, digest, _ = next(one for one in digests if unsealed(*one[:2])[2].endswith("="))
    signature = unsealed(key, digest)[2]
    letters = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
    last = signature.rstrip("=")[-1]
    other = signature.rstrip("=")[:-1] + letters[letters.index(last) ^ 1] + "=" * signature.count("=")
    assert b64decode(other) == b64decode(signature)
    changed = digest.replace(signature.encode(), other.encode())
    signer, trust = Signer.of(tls(keys, "node-a")), Trust(keys / "ca.crt")
    assert not trust.refuses("a", signer.certificate, *reversed(unsealed(key, digest)[1:]))
    assert trust.refuses("a", signer.certificate, *reversed(unsealed(key, changed)[1:]))


def test_a_clock_that_was_set_back_is_no_fraud(keys: Path) -> None:
    """Stamps come twice then; each second has its own messages, in the order in which they were written."""
    book, lines = DigestBook("a", "x", BEGAN_NS), []
    for k in range(400):
        at_ns = BEGAN_NS + k * S_NS // 10 - (30 * S_NS if k > 200 else 0)
        message = Depth(node="a", stamp_ns=at_ns, depth_m=float(k), sigma_m=0.1)
        book.add(topic_of(message), at_ns, encode(message))
        lines.append((key_of(message), encode(message), at_ns))
        if k % 10 == 9:
            digest = book.digest(at_ns + 1, last=k == 399)
            lines.append((key_of(digest), sealed(digest, None), at_ns + 1))
    assert not findings(lines, None)


def test_a_calibration_said_again_need_not_stand_twice(keys: Path) -> None:
    book = DigestBook("a", "x", BEGAN_NS)
    payload = encode(info(node="a", stamp_ns=BEGAN_NS))
    for _ in range(2):
        book.add(INFO, BEGAN_NS, payload)
    digest = (DIGEST.key("a"), sealed(book.digest(BEGAN_NS + S_NS, last=True), None), BEGAN_NS + S_NS)
    line = (INFO.key("a"), payload, BEGAN_NS)
    assert not findings([line, line, digest], None)
    assert not findings([line, digest], None)
    assert [one.kind for one in findings([line, line, line, digest], None)] == ["altered"]
    assert [one.kind for one in findings([digest], None)] == ["missing", "missing"]


def test_a_log_that_breaks_off_or_begins_late_says_so(keys: Path) -> None:
    lines = written("a", keys)
    assert [one.kind for one in findings(lines[:-1], keys)].count("altered") == 0
    assert {one.kind for one in findings(lines[:-12], keys)} == {"unsigned"}
    late = [lines[0], *lines[19:]]
    assert {one.kind for one in findings(late, keys)} == {"missing", "unsigned"}


def test_messages_whose_digest_never_came_are_nobodys_word_and_no_forgery(keys: Path) -> None:
    lines = written("a", keys)
    digests = [i for i, (key, _, _) in enumerate(lines) if key.endswith("/digest")]
    without = [line for i, line in enumerate(lines) if i != digests[2]]
    found = findings(without, keys)
    assert sorted(one.kind for one in found) == ["missing", "unsigned", "unsigned"]
    assert {one.words for one in found if one.kind == "unsigned"} == {
        "depth: 4 that are in no digest",
        "attitude: 4 that are in no digest",
    }
    # Elsewhere a message that is in no digest is one that the node did not write.
    key, _, at_ns = lines[digests[0] - 1]
    forged = encode(said("a", at_ns + 7, 99.0)[1])
    assert [one.kind for one in findings([*without[:5], (key, forged, at_ns), *without[5:]], keys)].count(
        "altered"
    ) == 1


def kinds(found: list[Discrepancy]) -> set[str]:
    return {one.kind for one in found}


def forged_at(at_ns: int) -> Line:
    return "buddyline/node/a/depth", encode(said("a", at_ns, 99.0)[0]), at_ns


def test_what_a_killed_run_said_last_is_no_forgery_once_the_next_run_signs(keys: Path) -> None:
    killed = written("a", keys, ended=False)[:-3]
    again = written("a", keys, "y", BEGAN_NS + 9 * S_NS)
    assert kinds(findings([*killed, *again], keys, own=False)) == {"missing", "unsigned"}
    # What neither run has said is named as before.
    for at_ns in (BEGAN_NS + 3 * S_NS + 5, BEGAN_NS + 12 * S_NS + 5):
        altered_ones = [
            one for one in findings([*killed, *again, forged_at(at_ns)], keys, own=False) if one.kind == "altered"
        ]
        assert [one.words for one in altered_ones] == ["depth: 1 that are in no digest"]


def test_messages_that_come_long_after_their_digest_are_no_forgery(keys: Path) -> None:
    """A recorder that joins late takes a digest from the node's log, and has fetched its messages over the bus."""
    lines = written("a", keys)
    at = next(index for index, line in enumerate(lines) if line[0].endswith("/digest") and index > len(lines) // 2)
    before = max(index for index in range(at) if lines[index][0].endswith("/digest"))
    late = [(key, payload, lines[-1][2] + LATE_NS + k) for k, (key, payload, _) in enumerate(lines[before + 1 : at])]
    found = findings([*lines[: before + 1], *lines[at:], *late], keys, own=False)
    assert kinds(found) == {"missing", "unsigned"}
    forged = forged_at(lines[before - 2][2])
    assert "altered" in kinds(findings([*lines[: before + 1], *lines[at:], *late, forged], keys, own=False))


def test_a_run_of_which_no_digest_is_there_is_no_forgery_once_the_next_run_signs(keys: Path) -> None:
    """A recording that begins just before a node is killed has its caches' messages, and no digest after them."""
    before = [line for line in written("a", keys, ended=False) if not line[0].endswith("/digest")]
    again = written("a", keys, "y", BEGAN_NS + 9 * S_NS)
    assert kinds(findings([*before, *again], keys, own=False)) == {"unsigned"}


def test_a_run_that_began_just_before_a_recording_ended_is_no_forgery(keys: Path) -> None:
    begun = written("a", keys, "y", BEGAN_NS + 9 * S_NS)[:5]
    assert kinds(findings([*written("a", keys), *begun], keys, own=False)) == {"unsigned"}


@pytest.mark.parametrize(("late_ns", "kind"), [(1, "unsigned"), (0, "altered")])
def test_late_samples_after_a_recordings_last_digest_are_no_forgery(late_ns: int, kind: str) -> None:
    """The node says what it measured 1.3 s ago; the recording has no digest of the last sample."""
    book, lines, said_ns = DigestBook("a", "x", BEGAN_NS), [], BEGAN_NS
    for k in range(20):
        said_ns = BEGAN_NS + k * S_NS // 10
        depth = Depth(node="a", stamp_ns=said_ns - 13 * S_NS // 10, depth_m=float(k), sigma_m=0.1)
        book.add(topic_of(depth), depth.stamp_ns, encode(depth))
        lines.append((key_of(depth), encode(depth), said_ns))
        if k % 10 == 9:
            digest = book.digest(said_ns)
            lines.append((key_of(digest), sealed(digest, None), said_ns))
    rest = Depth(node="a", stamp_ns=depth.stamp_ns + late_ns, depth_m=7.0, sigma_m=0.1)
    found = findings([*lines, (key_of(rest), encode(rest), said_ns + 1)], None, own=False)
    assert [one.kind for one in found if "no digest" in one.words] == [kind]


def test_a_calibration_said_again_excuses_no_forged_one() -> None:
    """The newest digest has the first calibration again, with its old stamp; the last digest is missing."""
    book, lines, now_ns = DigestBook("a", "x", BEGAN_NS), [], BEGAN_NS
    told = info(node="a", stamp_ns=BEGAN_NS)
    for k in range(20):
        now_ns = BEGAN_NS + k * S_NS
        for message in [told] * (k in (0, 19)) + said("a", now_ns, float(k)):
            book.add(topic_of(message), message.stamp_ns, encode(message))
            lines.append((key_of(message), encode(message), now_ns))
        digest = book.digest(now_ns + S_NS // 2)
        lines.append((key_of(digest), sealed(digest, None), now_ns + S_NS // 2))
    forged = info(node="a", stamp_ns=BEGAN_NS + 10 * S_NS)
    lines.insert(len(lines) // 2, (key_of(forged), encode(forged), forged.stamp_ns))
    found = findings(lines, None, own=False)
    assert [one.kind for one in found if one.words.startswith("info")] == ["altered"]


def test_a_clock_that_is_set_back_while_a_node_is_down_makes_no_forgery(keys: Path) -> None:
    killed = written("a", keys, ended=False)[:-5]
    again = written("a", keys, "y", BEGAN_NS - 3 * S_NS // 2)
    lines = [*killed, *((key, payload, at_ns + 9 * S_NS) for key, payload, at_ns in again)]
    assert "altered" not in kinds(findings(lines, keys, own=False))


def test_in_a_nodes_own_whole_log_all_that_is_in_no_digest_is_a_forgery(keys: Path) -> None:
    lines = written("a", keys)
    for at_ns in (BEGAN_NS - 1000 * S_NS, BEGAN_NS + 3 * S_NS + 5, BEGAN_NS + 1000 * S_NS):
        assert [one.kind for one in findings([*lines[:20], forged_at(at_ns), *lines[20:]], keys)] == ["altered"]
    spliced = [*lines[:46], *written("a", keys, "y", BEGAN_NS + 1000 * S_NS)[46:]]
    assert "a digest of another run of the node" in {one.words for one in findings(spliced, keys)}


@pytest.mark.parametrize(("again_s", "kind"), [(0.0, "altered"), (8.0, "unsigned")])
def test_a_calibration_that_is_said_again_for_a_new_hub_may_lack_its_digest(
    keys: Path, again_s: float, kind: str
) -> None:
    lines = written("a", keys, ended=False)
    again = (*lines[0][:2], BEGAN_NS + round(again_s * S_NS) + S_NS // 2)
    found = findings(sorted([*lines, again], key=lambda line: line[2]), keys, own=False)
    assert [one.kind for one in found if one.words == "info: 1 that are in no digest"] == [kind]


@pytest.mark.parametrize("seed", range(40))
def test_no_kill_and_no_loss_of_digests_is_called_a_forgery(keys: Path, seed: int) -> None:
    """Runs that are killed anywhere, digests that never come, a recording that begins and ends anywhere."""
    rng = random.Random(seed)
    lines: list[Line] = []
    began_ns = BEGAN_NS
    for run in range(4):
        of_run = written("a", keys, f"run{run}", began_ns, ended=rng.random() < 0.3)
        began_ns += rng.choice((7, 9)) * S_NS
        if "last" not in of_run[-1][1].decode():
            of_run = of_run[: rng.randrange(2, len(of_run))]
        lines += of_run
    rare = rng.choice((0.0, 0.1, 0.5))
    lines = [line for line in lines if not (line[0].endswith("/digest") and rng.random() < rare)]
    infos = [line for line in lines if line[0].endswith("/info")]
    kept = lines[rng.randrange(len(lines) // 2) : rng.randrange(len(lines) // 2, len(lines))]
    found = findings([*infos[:1], *(line for line in kept if line not in infos[:1])], keys, own=False)
    assert "altered" not in kinds(found), found


def test_a_flood_fills_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_WAITING", 50)
    monkeypatch.setattr(module, "MAX_WAITING_TOGETHER", 200)
    monkeypatch.setattr(module, "MAX_DUE", 5)
    check, book = DigestCheck(), DigestBook("a", "x", BEGAN_NS)
    for k in range(1000):
        node = f"n{k % 100}"
        list(check.add(f"buddyline/node/{node}/depth", b'{"stamp_ns":%d}' % k, BEGAN_NS))
        digest = book.digest(BEGAN_NS)
        list(check.add(key_of(digest), sealed(digest, None), BEGAN_NS))
    assert sum(len(one.waiting["depth"]) for one in check.nodes.values()) <= 200
    assert len(check.nodes["a"].due) <= 5


def test_digests_of_invented_runs_topics_and_numbers_fill_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_BOOTS", 5)
    monkeypatch.setattr(module, "MAX_ABSENT", 100)
    check = DigestCheck()
    for k in range(50):
        line = Said(topic=f"t{k}", count=1, first_ns=0, last_ns=0, sha256="0" * 32)
        digest = Digest(node="a", stamp_ns=BEGAN_NS, boot=f"x{k}", seq=2**62, since_ns=BEGAN_NS, said=[line])
        list(check.add(key_of(digest), sealed(digest, None), BEGAN_NS + k))
    found = list(check.finish())
    of = check.nodes["a"]
    assert len(of.newest) == len(of.absent) == 5
    assert sum(map(len, of.absent.values())) == 100
    assert not of.waiting
    assert "digests of more than 5 runs of the node" in {one.words for one in found}


@pytest.mark.slow
def test_ten_thousand_attacks_are_named(keys: Path) -> None:
    assert not [one for one in attacked(10_000, keys, seed=2) if not named(*one[1:])]
