"""Stations that mark themselves: printed sheets, which rest a tag's mark belongs to, and whole networks."""

import io

import cv2
import numpy as np
import pytest
from buddyline.node.station_tags import DICTIONARY
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Mark
from buddyline.tools.cli import main
from buddyline.tools.draw.tag_sheet import A4_MM, tag_sheet
from buddyline.tools.survey.chain import Stop, find_standings
from buddyline.tools.survey.derive import Derived
from buddyline.tools.survey.readings import of_messages
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings

from tests.tools import survey_world as world
from tests.tools.tagged_survey import judge


@pytest.fixture(scope="module")
def messages():
    return world.dive(world.line(np.random.default_rng(2), 2), np.random.default_rng(7), rest_s=8.0, swim_s=2.0)


def derived(messages):
    found = Derived()
    found.add(of_messages(messages), SurveySettings(), AlarmSettings())
    return found


def test_a_tag_names_the_rest_that_follows(messages):
    legs = derived(messages).legs

    def named(*marks):
        return [(leg.from_, leg.to) for leg in derived([*messages, *marks]).legs]

    # Between the rests b stays where it is and a swims on: what a reads right after the first rest is not there.
    between_ns = (legs[0].end_ns + legs[1].start_ns) // 2
    tag = Mark(node="a", stamp_ns=legs[0].end_ns + S_NS // 2, name="T105", tag=105)
    assert named(tag) == [("0", "1"), ("1", "T105")]
    assert named(Mark(node="a", stamp_ns=legs[0].end_ns + S_NS // 2, name="T105"))[0] == ("T105", "0")
    assert named(Mark(node="b", stamp_ns=between_ns, name="T105", tag=105)) == [("0", "T105"), ("T105", "2")]
    # A person's mark goes before a tag's, whatever came later.
    typed = Mark(node="a", stamp_ns=legs[1].start_ns - 2 * S_NS, name="M7")
    assert named(typed, Mark(node="a", stamp_ns=between_ns, name="T105", tag=105))[1] == ("1", "M7")
    # A tag that was seen at no rest is no fault.
    swum_past = derived([*messages, Mark(node="a", stamp_ns=legs[1].end_ns + S_NS, name="T105", tag=105)])
    assert not swum_past.faults
    assert not swum_past.problems


def test_a_tag_of_the_other_node_s_station_is_not_used():
    def at(line, *names, tagged=""):
        return Stop(np.array(line, float), {"a": 10.0, "b": 10.0}, dict(names), frozenset(tagged))

    # a swims past b, reads its tag there, and no other one.
    stops = [
        at((5, 0, 0), ("a", "T100"), ("b", "T101"), tagged="ab"),
        at((-4, 2, 0), ("a", "T101"), tagged="a"),
        at((4, 3, 0), ("b", "T103"), tagged="b"),
    ]
    standings = find_standings(stops, "leapfrog", "a")
    assert [(one.station["a"], one.station["b"]) for one in standings] == [
        ("T100", "T101"),
        ("0", "T101"),
        ("0", "T103"),
    ]
    assert ["tag T101 of the other node's station" in one.problem for one in standings] == [False, True, False]
    # b has left the station by then, and says so: a has come to it.
    moved = find_standings([stops[0], at((5, 5, 0), ("a", "T101"), ("b", "T102"), tagged="ab")], "leapfrog", "a")
    assert moved[1].station == {"a": "T101", "b": "T102"}


def test_a_tag_read_at_both_ends_of_a_leg_is_said(messages):
    first = derived(messages).legs[0]
    both = [Mark(node=node, stamp_ns=first.start_ns, name="T105", tag=105) for node in "ab"]
    assert any("both nodes at station T105" in alarm for alarm in derived([*messages, *both]).legs[0].alarms)


def test_a_printed_sheet_has_its_tags_at_their_true_size():
    pages = tag_sheet(range(100, 108), 60.0)
    assert len(pages) == 2
    found = {}
    for page in pages:
        file = io.BytesIO()
        page.savefig(file, format="png", dpi=127)
        picture = cv2.imdecode(np.frombuffer(file.getvalue(), np.uint8), cv2.IMREAD_GRAYSCALE)
        assert picture.shape[::-1] == pytest.approx(np.array(A4_MM) * 5, abs=1)
        detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARY))
        corners, ids, _ = detector.detectMarkers(picture)
        found |= {int(number): corner.reshape(4, 2) for number, corner in zip(np.ravel(ids), corners, strict=True)}
    assert sorted(found) == list(range(100, 108))
    for corners in found.values():
        assert np.linalg.norm(corners[1] - corners[0]) == pytest.approx(300, abs=3)


def test_the_command_writes_tags_and_refuses_others(tmp_path, capsys):
    out = tmp_path / "tags.pdf"
    assert main(["survey", "tags", "100", "101", "-o", str(out)]) == 0
    assert out.read_bytes().startswith(b"%PDF")
    for words in (["3", "8"], ["580", "600"], ["120", "110"], ["100", "101", "--side-mm", "200"]):
        assert main(["survey", "tags", *words, "-o", str(tmp_path / "no.pdf")]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert "from 100 to 586" in said[-4]
    assert "fits on a page" in said[-1]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_network_of_two_loops_in_two_dives_names_itself():
    # Twenty of them: python -m tests.tools.tagged_survey.
    assert judge(0) == (True, False)
