"""Old surveys are read as they are meant, and what cannot be read is refused by file, line and value."""

import pytest
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.old.joining import joined, named
from buddyline.tools.survey.old.model import North
from buddyline.tools.survey.old.readers import read_old
from buddyline.tools.survey.old.systems import map_system
from buddyline.tools.survey.project import Project

from tests.tools.old_cave import CAVE, DAT, TH, read


def test_bearings_of_a_table_are_magnetic_where_it_states_no_declination(tmp_path):
    (tmp_path / "d.csv").write_text(
        "from,to,length,azimuth,clino,declination,date\n1,2,5,90,0,,2019-07-27\n2,3,5,90,0,2.5,\n3,4,5,90,0,,\n"
    )
    old = read_old(tmp_path / "d.csv")
    assert [shot.north for shot in old.shots] == [North("model"), North("grid", 2.5), North("model")]
    assert old.left_out == ["shots with neither declination nor date: 1; there declination is 0"]


def test_a_svx_file_is_read_as_it_is_meant(tmp_path):
    old = read(tmp_path, CAVE)
    first = old.shots[0]
    assert (first.start, first.end, first.survey) == ("cave.entrance.1", "cave.entrance.2", ("cave", "entrance"))
    assert first.tape_m == pytest.approx(33.0 * 0.3048 - 0.1)
    assert (first.north.value_deg, first.when.isoformat(), first.sigma("compass")) == (-3.5, "1987-07-27", 1.5)
    by_end = {shot.end.rpartition(".")[2]: shot for shot in old.shots}
    assert by_end["4"].clino_word == "up"
    assert old.shots[3].rise_m == pytest.approx(-2.5)
    assert (by_end["3"].back_deg, by_end["3"].back_clino_deg) == (271, -11)
    assert [shot.end for shot in old.shots if "splay" in shot.flags] == [""]
    assert [shot.start for shot in old.shots if "duplicate" in shot.flags] == ["cave.stream.3"]
    assert by_end["5"].vector_m == (1.5, -2.5, 0.5)
    assert old.passages[0].sections[1].up_m is None
    assert old.passages[0].sections[1].down_m == 1.6
    assert old.entrances == ["cave.entrance.1"]
    assert old.surveys["cave", "entrance"].team == ["Ann Diver"]


def test_a_th_file_is_read_as_it_is_meant(tmp_path):
    old = read(tmp_path, TH, "cave.th")
    first = old.shots[0]
    assert (first.start, first.tape_m, first.compass_deg) == ("cave.1", pytest.approx(10.0), pytest.approx(45.0))
    assert [(shot.start, shot.flags) for shot in old.shots if not shot.end] == [("cave.2", {"splay", "wall"})]
    assert old.shots[3].extend == "left"
    assert old.shots[3].rise_m == 2.5
    assert old.shots[-1].north.value_deg == 4.0
    assert old.equates == [("cave.4", "cave.side.a")]
    assert (old.entrances, old.station_notes) == (["cave.1"], {"cave.1": "mouth"})
    assert old.surveys["cave",].title == "Old Cave"
    assert old.passages[1].sections[0].right_m == 2.0


BAD = {
    "number": ("1 2 ten 90 0\n", "cave.svx:1: tape: 'ten' is not a number"),
    "few": ("1 2 10.0 90\n", "cave.svx:1: '1 2 10.0 90' ends before its clino"),
    "many": ("1 2 10.0 90 0 7\n", "cave.svx:1: '7' is too much"),
    "command": ("*surey x\n", "cave.svx:1: '*surey' is no command"),
    "unit": ("\n*units tape parsecs\n", "cave.svx:2: 'parsecs' is no unit of tape"),
    "style": ("*data normel from to\n", "cave.svx:1: *data normel: no such style"),
    "open": ("*begin a\n1 2 1 0 0\n", "cave.svx:3: *begin a of cave.svx:1 has no *end"),
    "end": ("*begin a\n*end b\n", "cave.svx:2: *end b: the block of cave.svx:1 is *begin a"),
    "date": ("*date 2001.13.01\n", "cave.svx:1: '2001.13.01' is no date"),
    "include": ("*include nowhere\n", "cave.svx:1: 'nowhere': no such file"),
    "itself": ("*include cave\n", "include each other more than"),
    "name": ("a! 2 1 0 0\n", "cave.svx:1: station 'a!': '!' is not allowed"),
    "compass": ("1 2 10 - 0\n", "cave.svx:1: compass: '-' is for plumbed legs alone"),
    "sd": ("*sd tape 0 metres\n", "cave.svx:1: standard deviation: '0' is not above zero"),
    "infinite": ("1 2 1e999 0 0\n", "cave.svx:1: tape: '1e999' is out of range"),
    "empty": ("; nothing\n", "cave.svx: no shot in it"),
    "binary": ("1 2 \0", "cave.svx: byte 4 is zero"),
}


@pytest.mark.parametrize(("text", "said"), BAD.values(), ids=BAD)
def test_bad_svx_is_refused_by_file_line_and_value(tmp_path, text, said):
    with pytest.raises(BuddylineError) as refused:
        read(tmp_path, text)
    assert said in str(refused.value)


BAD_TH = {
    "survey": ("survey a\n", "cave.th:2: survey a has no endsurvey"),
    "command": ("servey a\n", "cave.th:1: 'servey' is no command"),
    "number": ("centreline\ndata normal from to tape compass clino\n1 2 3 4 five\n", "cave.th:3: clino: 'five'"),
    "fix": ("centreline\nfix 1 2 3\n", "cave.th:2: fix 1: x, y and z"),
    "input": ("input no.th\n", "cave.th:1: 'no.th': no such file"),
}


@pytest.mark.parametrize("name", ["side.th", "SIDE.TH"])
def test_therion_data_within_svx_are_refused_because_they_would_stand_at_the_root(tmp_path, name):
    (tmp_path / name).write_text(TH)
    with pytest.raises(BuddylineError) as refused:
        read(tmp_path, f"*begin cave\n*include {name}\n*end cave\n")
    said = str(refused.value)
    assert f"cave.svx:2: *include {name}: Therion data would stand at the root" in said
    assert "`survey import` that file as well" in said


@pytest.mark.parametrize(("text", "said"), BAD_TH.values(), ids=BAD_TH)
def test_bad_th_is_refused_by_file_line_and_value(tmp_path, text, said):
    with pytest.raises(BuddylineError) as refused:
        read(tmp_path, text, "cave.th")
    assert said in str(refused.value)


MAK = """\
/ two files in one
@420000.0,5260000.0,50.0,0,0.0;
&WGS 1984;
$33;
#cave.dat,
A1[m,420000.0,5260000.0,50.0];
"""
TXT = """\
FIX
1.0\t10\t20\t30
TRIP
DATE 2008-01-01
DECLINATION\t2.00
DATA
1.0\t1.1\t90.00\t-5.00\t4.000\t>
1.0\t\t180.00\t1.00\t2.000\t<
"""
CSV = """\
from;to;distance (ft);azimuth_deg;inclination_deg;left;right;up;down;flags;date
1;2;10,0;90;-5;1;2;;;duplicate;2020-02-03
2;-;3;180;0;;;;;;
"""


def test_compass_data_are_read_in_metres_with_corrections_taken_in(tmp_path):
    old = read(tmp_path, DAT.replace("\n", "\r\n") + "\f\r\n\x1a", "cave.dat")
    first, second = old.shots
    assert first.tape_m == pytest.approx(33.0 * 0.3048)
    assert (first.compass_deg, first.clino_deg, first.back_deg, first.back_clino_deg) == (46.0, -9.5, 227.0, 11.0)
    assert (first.north.value_deg, first.when.isoformat(), first.note) == (4.0, "1986-10-13", "wide")
    assert (second.end, second.compass_deg, second.back_deg) == ("B!", None, 101.0)
    assert second.flags == {"surface", "duplicate"}
    assert old.passages[0].sections[0].right_m == pytest.approx(4 * 0.3048)
    assert old.left_out == ["cave.dat:12: A2 X, which the file excludes"]
    assert old.surveys[()].team == ["Ann Diver", "Bo Fin"]


def test_a_compass_project_has_place_and_fixed_points(tmp_path):
    (tmp_path / "cave.dat").write_text(DAT)
    old = read(tmp_path, MAK, "cave.mak")
    assert old.fixes[0].position == (420000.0, 5260000.0, 50.0)
    assert map_system(old) == "UTM33N"
    assert joined(Project(), [named(old, "cave")]).place.epsg == 32633


def test_tables_and_pockettopo_are_read(tmp_path):
    old = read(tmp_path, CSV, "cave.csv")
    first, splay = old.shots
    assert (first.tape_m, first.when.isoformat(), first.flags) == (pytest.approx(3.048), "2020-02-03", {"duplicate"})
    assert (splay.end, splay.flags) == ("", {"splay"})
    old = read(tmp_path, TXT, "cave.txt")
    assert (old.shots[0].compass_deg, old.shots[0].north.value_deg, old.shots[0].extend) == (90.0, 2.0, "right")
    assert old.shots[1].flags == {"splay"}
    assert old.fixes[0].position == (10.0, 20.0, 30.0)
    assert read(tmp_path, "# TopoDroid\n1@a,2@a,3.5,90.1,-5\n", "droid.csv").shots[0].polar == (
        3.5,
        90.1,
        pytest.approx(-5),
    )


SRV = """\
; the common part of Walls
#units feet decl=3.5 order=dav typeab=c typevb=c lrud=F:LRUD
#date 1990-09-09
#prefix top
#fix A1 100m 200m 300m
A1 A2 32.81 45/46 -10/-11 <1,2,--,4>
A2 A3 16i6 N45E 5
A2 - 10 180 0
#units rect
A3 B:A4 3m 4m 5m #s /S
#[
nonsense
#]
"""


def test_walls_data_are_read(tmp_path):
    old = read(tmp_path, SRV, "cave.srv")
    first, second, splay, last = old.shots
    assert (first.start, first.tape_m) == ("top.A1", pytest.approx(32.81 * 0.3048))
    # Corrected backsights read as foresights do.
    assert (first.back_deg, first.back_clino_deg, first.north.value_deg) == (46 + 180, 11.0, 3.5)
    assert (second.tape_m, second.compass_deg) == (pytest.approx(16.5 * 0.3048), 45.0)
    assert splay.flags == {"splay", "wall"}
    assert (last.vector_m, last.end, last.flags) == ((3.0, 4.0, 5.0), "B.A4", {"surface"})
    assert old.fixes[0].position == pytest.approx((100.0, 200.0, 300.0))
    assert old.passages[0].sections[0].up_m is None
    assert old.passages[0].sections[0].down_m == pytest.approx(4 * 0.3048)
    assert first.when.isoformat() == "1990-09-09"


BAD_TABLES = {
    "srv number": ("A B ten 0 0\n", "cave.srv", "cave.srv:1: distance: 'ten' is not a number"),
    "srv few": ("A B 10\n", "cave.srv", "cave.srv:1: 'A B 10' ends before its A; order DAV"),
    "srv units": ("#units inca=2\n", "cave.srv", "cave.srv:1: #units inca=2: this correction is not read here"),
    "srv option": ("#units furlongs\n", "cave.srv", "cave.srv:1: #units furlongs: no such option"),
    "srv date": ("#date 1990-13-01\n", "cave.srv", "cave.srv:1: #date '1990-13-01'"),
    "dat number": (DAT.replace("32.90", "long"), "cave.dat", "cave.dat:10: LENGTH: 'long' is not a number"),
    "dat date": (DAT.replace("10 13 1986", "13 10 1986"), "cave.dat", "cave.dat:3: SURVEY DATE: '13 10 1986'"),
    "dat columns": (DAT.replace("226.00 10.50 wide", ""), "cave.dat", "cave.dat:10: "),
    "dat heading": ("nothing\n", "cave.dat", "cave.dat:1: 'nothing' begins no survey"),
    "mak file": ("#none.dat;\n", "cave.mak", "cave.mak:1: 'none.dat': no such file"),
    "csv columns": ("a,b,c\n1,2,3\n", "cave.csv", "cave.csv:1: 'a,b,c' names no columns"),
    "csv number": (CSV.replace("10,0", "ten"), "cave.csv", "cave.csv:2: tape: 'ten' is not a number"),
    "csv date": (CSV.replace("2020-02-03", "3.2.20"), "cave.csv", "cave.csv:2: date: '3.2.20'"),
    "txt": (TXT.replace("-5.00", "minus"), "cave.txt", "cave.txt:7: DATA: 'minus'"),
}


@pytest.mark.parametrize(("text", "name", "said"), BAD_TABLES.values(), ids=BAD_TABLES)
def test_bad_tables_are_refused_by_file_line_and_value(tmp_path, text, name, said):
    with pytest.raises(BuddylineError) as refused:
        read(tmp_path, text, name)
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("old.svx", "*data normal from to tape compass clino\r\n1 2 10 90 0\r\n\x1a"),
        (
            "old.th",
            "survey a\ncentreline\ndata normal from to length compass clino\n1 2 10 90 0\n"
            "endcentreline\nendsurvey\n\x1a",
        ),
        ("old.csv", "from,to,tape,compass,clino\r\n1,2,10,90,0\r\n\x1a\r\n"),
    ],
)
def test_a_text_may_end_as_programs_of_dos_ended_it(tmp_path, name, text):
    path = tmp_path / name
    path.write_bytes(text.encode())
    assert [shot.tape_m for shot in read_old(path).shots] == [10.0]
