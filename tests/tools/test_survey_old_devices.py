"""Files of divers' own instruments and their program: Mnemo and JedEye (.dmp), Ariane (.tml)."""

import struct
import zipfile

import pytest
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.old.joining import joined
from buddyline.tools.survey.old.readers import read_old
from buddyline.tools.survey.project import Project

SECTION_MARK, SHOT_MARK, SHOT_END = b"\x44\x59\x65", b"\x39\x43\x4d", b"\x5f\x19\x23"


def shot(version, heading, second_heading, length, depths, *, sides=(0, 0, 0, 0), kind=2):
    """Return a shot as a Mnemo of this version writes it: tenths of a degree, centimetres."""
    row = struct.pack(">B7h", kind, heading, second_heading, length, *depths, -17, -18)
    row += struct.pack(">4h", *sides) if version >= 4 else b""
    row += struct.pack(">h3B", 182, 16, 6, 12) if version >= 3 else b""
    row += b"\0"
    return SHOT_MARK + row + SHOT_END if version >= 5 else row


def section(version, name, shots, *, day=18, outward=0):
    """Return a section with its last record."""
    firmware = bytes((2, 9, 3)) if version == 7 else b""
    head = bytes((version,)) + (SECTION_MARK if version >= 3 else b"") + firmware + bytes((26, 11, day, 12, 33))
    return head + name + bytes((outward,)) + b"".join(shots) + shot(version, 0, 0, 0, (0, 0), kind=3)


def dmp(path, data):
    """Write bytes as a .dmp file has them: signed numbers with semicolons."""
    path.write_text("".join(f"{byte - 256 if byte > 127 else byte};" for byte in data))
    return path


@pytest.mark.parametrize("version", [2, 3, 4, 5, 6, 7])
def test_a_dmp_file_is_read_as_it_is_meant(tmp_path, version):
    shots = [
        shot(version, 3590, 30, 1200, (210, 530), sides=(150, 200, 80, 60)),
        shot(version, 900, 904, 800, (530, 480)),
    ]
    data = section(version, b"B 1", shots) + section(version, b"B 1", [shot(version, 10, 10, 300, (0, 0))], outward=1)
    old = read_old(dmp(tmp_path / "cave.dmp", data + b"MN2Over"))
    assert [(one.start, one.end) for one in old.shots] == [
        ("B_1.0", "B_1.1"),
        ("B_1.1", "B_1.2"),
        ("B_1_2.0", "B_1_2.1"),
    ]
    first = old.shots[0]
    assert (first.tape_m, first.compass_deg, first.when.isoformat()) == (12.0, pytest.approx(1.0), "2026-11-18")
    # 3.2 m deeper at its end.
    assert first.rise_m == pytest.approx(-3.2)
    assert old.surveys["B_1_2",].notes == ["surveyed on the way out"]
    assert not old.left_out
    widths = [section.left_m for passage in old.passages for section in passage.sections]
    assert widths == ([1.5] if version >= 4 else [])
    legs = joined(Project(), [old]).leg
    assert legs[1].inclination_deg == pytest.approx(3.583, abs=1e-3)


@pytest.mark.parametrize(("version", "order"), [(6, "little"), (7, "big")])
def test_points_of_walls_are_passed_over(tmp_path, version, order):
    scan = b"\x20\x21\x22" + (12).to_bytes(2, order) + bytes(range(12))
    shots = [shot(version, 900, 900, 500, (0, 0)) + scan, shot(version, 910, 910, 400, (0, 10))]
    old = read_old(dmp(tmp_path / "cave.dmp", section(version, b"JD1", shots)))
    assert [one.tape_m for one in old.shots] == [5.0, 4.0]


def test_a_damaged_section_costs_what_follows_in_it(tmp_path):
    good = section(5, b"AA1", [shot(5, 900, 900, 500, (0, 0)), shot(5, 900, 900, 600, (0, 0))])
    bad = bytearray(good)
    bad[13 + 35] = 0
    old = read_old(dmp(tmp_path / "cave.dmp", bytes(bad) + section(5, b"BB1", [shot(5, 10, 10, 700, (0, 0))])))
    assert [one.tape_m for one in old.shots] == [5.0, 7.0]
    assert len(old.left_out) == 1
    assert "value 49: a shot's mark is not where it should be" in old.left_out[0]


def test_a_reference_shot_and_a_day_that_does_not_exist_are_said(tmp_path):
    shots = [shot(5, 10, 10, 100, (0, 0), kind=0), shot(5, 900, 900, 500, (0, 0))]
    old = read_old(dmp(tmp_path / "cave.dmp", section(5, b"AA1", shots, day=31)))
    assert [one.when for one in old.shots] == [None]
    assert [line.partition(": ")[2] for line in old.left_out] == [
        "section AA1: 2026-11-31 is no date; declination is 0",
        "section AA1: a reference shot after station 0",
    ]


BAD_DMP = {
    "word": ("5;68;x;", "value 3: 'x' is not a number from -128 to 255"),
    "large": ("5;68;300;", "value 3: '300' is not a number from -128 to 255"),
    "version": ("9;1;2;", "value 1: 9 is no version of a section"),
    "mark": ("5;68;89;1;", "value 2: the section's mark is not where it should be"),
    "cut": ("5;68;89;101;23;11;18;", "value 7: the file ends within a section"),
    "empty": ("", "no shot in it"),
}


@pytest.mark.parametrize("case", BAD_DMP)
def test_a_file_that_is_no_dmp_is_refused_by_value(tmp_path, case):
    text, said = BAD_DMP[case]
    path = tmp_path / "cave.dmp"
    path.write_text(text)
    with pytest.raises(BuddylineError, match=r"cave\.dmp: ") as error:
        read_old(path)
    assert said in str(error.value)


def entry(number, before, **fields):
    """Return an entry of Ariane's list."""
    own = {"ID": number, "FromID": before, "ClosureToID": -1, "DepthIn": -1.0, "Date": "2026-05-01", "Type": "REAL"}
    own |= {"Excluded": "false", **fields}
    shape = "<Shape><RadiusCollection/></Shape>"
    return f"<SurveyData>{''.join(f'<{k}>{v}</{k}>' for k, v in own.items())}{shape}</SurveyData>"


LOOP = [
    entry(0, -1, Type="START", Depth=0.0, Latitude=20.25, Longitude=-87.48, Name="mouth"),
    entry(1, 0, Azimut=90.0, Length=10.0, Depth=6.0, Left=1.0, Section="Main line"),
    entry(2, 1, Azimut=180.0, Length=5.0, Depth=6.0, Excluded="true"),
    entry(3, 2, Azimut=300.0, Length=8.0, Depth=0.1, DepthIn=6.0, ClosureToID=0, Type="CLOSURE"),
]


def tml(path, entries, unit="m", name="Data.xml", magnetic="true"):
    """Write a file as Ariane packs it."""
    head = f"<caveName>Old</caveName><unit>{unit}</unit><useMagneticAzimuth>{magnetic}</useMagneticAzimuth>"
    text = f'<?xml version="1.0"?><CaveFile>{head}<Data>{"".join(entries)}</Data></CaveFile>'
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr(name, text)
    return path


def test_a_tml_file_is_read_as_it_is_meant(tmp_path):
    old = read_old(tml(tmp_path / "cave.tml", LOOP))
    assert [(one.start, one.end, one.rise_m) for one in old.shots] == [
        ("0", "1", -6.0),
        ("1", "2", 0.0),
        ("2", "3", 5.9),
    ]
    assert [one.flags for one in old.shots] == [frozenset(), {"duplicate"}, frozenset()]
    assert (old.shots[0].north.kind, old.shots[0].note, old.shots[0].when.isoformat()) == (
        "model",
        "Main line",
        "2026-05-01",
    )
    assert old.equates == [("3", "0")]
    assert old.fixes[0].position == (-87.48, 20.25, 0.0)
    assert (old.passages[0].sections[0].station, old.passages[0].sections[0].left_m) == ("1", 1.0)
    assert (old.surveys[()].title, old.station_notes) == ("Old", {"0": "mouth"})


def test_feet_and_true_north_of_a_tml_file(tmp_path):
    old = read_old(tml(tmp_path / "cave.tml", LOOP, unit="ft", magnetic="false"))
    assert (old.shots[0].tape_m, old.shots[0].rise_m) == (pytest.approx(3.048), pytest.approx(-1.8288))
    assert old.shots[0].north.kind == "true"


BAD_TML = {
    "number": ([entry(0, -1, Depth="deep")], {}, "entry 0: Depth: 'deep' is not a number"),
    "from": ([entry(0, -1, Depth=0), entry(1, 7, Depth=0)], {}, "entry 1: FromID: there is no entry 7"),
    "id": ([entry("a", -1, Depth=0)], {}, "ID: 'a' is not a number"),
    "date": ([entry(0, -1), entry(1, 0, Depth=0, Date="May")], {}, "entry 1: Date: 'May' is no date"),
    "unit": (LOOP, {"unit": "fathoms"}, "unit: 'fathoms' is none of"),
    "inside": (LOOP, {"name": "Other.xml"}, "there is no Data.xml in it"),
    "tags": (["<SurveyData>"], {}, "Data.xml: mismatched tag"),
    "empty": ([], {}, "no shot in it"),
}


@pytest.mark.parametrize("case", BAD_TML)
def test_a_file_that_is_no_tml_is_refused_by_entry(tmp_path, case):
    entries, options, said = BAD_TML[case]
    with pytest.raises(BuddylineError, match=r"cave\.tml: ") as error:
        read_old(tml(tmp_path / "cave.tml", entries, **options))
    assert said in str(error.value)


def test_entities_and_other_files_are_refused(tmp_path):
    path = tmp_path / "cave.tml"
    with zipfile.ZipFile(path, "w") as packed:
        packed.writestr("Data.xml", '<!DOCTYPE a [<!ENTITY b "c">]><CaveFile/>')
    with pytest.raises(BuddylineError, match="defines entities"):
        read_old(path)
    path.write_bytes(b"PK no zip")
    with pytest.raises(BuddylineError, match="cannot be unpacked"):
        read_old(path)


def test_a_packed_file_that_grows_beyond_measure_is_not_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr("buddyline.tools.survey.old.ariane.MOST_BYTES", 1000)
    with pytest.raises(BuddylineError, match="at most 1000 are read"):
        read_old(tml(tmp_path / "cave.tml", LOOP * 5))


def test_a_damaged_archive_is_refused(tmp_path):
    path = tml(tmp_path / "cave.tml", LOOP)
    data = bytearray(path.read_bytes())
    data[60:80] = b"\xff" * 20
    path.write_bytes(data)
    with pytest.raises(BuddylineError, match=r"cave\.tml: cannot be unpacked"):
        read_old(path)
