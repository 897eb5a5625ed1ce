"""Old surveys: read, adjusted with new legs, and written again, against the programs that made them."""

import argparse
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey import command, survex
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.old.joining import joined, named, same_place
from buddyline.tools.survey.old.model import OldSurvey
from buddyline.tools.survey.old.readers import read_old
from buddyline.tools.survey.old.systems import map_system
from buddyline.tools.survey.old.writing import svx_of, svx_system, th_of, therion_system
from buddyline.tools.survey.project import Equate, Project, load_project
from buddyline.tools.survey.sheet import Sheet
from msgspec.structs import replace

from tests.processes import PATIENCE_S
from tests.tools import survey_world as world

CAVERN = pytest.mark.skipif(shutil.which("cavern") is None, reason="survex is not installed")
THERION = pytest.mark.skipif(shutil.which("therion") is None, reason="therion is not installed")
SAMPLES = Path("/usr/share/doc/therion/examples/samples")
# Both programs write centimetres: rounding of two coordinates.
SAME_M = 0.0101

CAVE = """\
; the whole language in one cave
*begin cave
*title "Old Cave"
*export entrance.1
*fix entrance.1 100 200 300
*entrance entrance.1
*equate entrance.3 stream.0
*begin entrance
*export 1 3
*date 1987.07.27
*team "Ann Diver" tape
*instrument compass "Suunto 7"
*declination -3.5 degrees
*calibrate tape +0.1
*units tape feet
*sd compass 1.5 degrees
1 2 33.0 045 -10
2 3 20.0 100.5 +15
3 1 46.2 245 +0.7
*end entrance
*begin stream
*export 0
*data diving from to tape compass fromdepth todepth
*calibrate depth 0 -1
0 1 12.5 310 3.0 5.5
*data normal station newline tape compass clino
1
 8.25 011 UP

1
 6.0 100 LEVEL
2
*data normal from to tape compass backcompass clino backclino
2 3 5.00 090 271 10 -11
*flags splay
3 .. 2.5 000 - 05 -
*flags not splay duplicate
3 1 10.9 275.5 - -5 -
*flags not duplicate
*data cartesian from to easting northing altitude
3 5 1.5 -2.5 0.5
*data cylpolar from to tape compass fromdepth todepth
5 6 4.0 S45E 8.0 9.0
*data passage station left right up down
2 1.0 2.0 0.5 1.5
3 1.1 2.1 - 1.6
*end stream
*end cave
"""
CAVE = CAVE.replace(" 8.25 011 UP\n\n", " 8.25 - UP\n4\n\n").replace("S45E", "135")

TH = """\
encoding utf-8
survey cave -title "Old Cave"
  centreline
    date 2019.07.27
    team "Ann Diver"
    units compass clino grads
    calibrate length 0.05
    data normal from to length compass clino left right up down
    1 2 10.05 50 -10 1 2 3 4
    2 3 8.05 [100] 5 1 [2 3] 3 4
    2 - 3.05 200 0 - - - -
    extend left
    data diving from to length compass depthchange
    3 4 12.05 320 2.5
    station 1 "mouth" entrance
  endcentreline
  survey side
    centreline
      declination 4.0 degrees
      data cartesian from to dx dy dz
      a b 1 2 3
      data normal from to length compass backcompass clino backclino
      b c 5 10 190.5 0 0.4
    endcentreline
  endsurvey side
  equate 4 a@side
endsurvey cave
"""


def read(folder, text, name="cave.svx"):
    (folder / name).write_text(text)
    return read_old(folder / name)


def places(file):
    """Return a .3d file's stations by full name with points, whichever program wrote it."""
    done = subprocess.run(["dump3d", str(file)], capture_output=True, timeout=PATIENCE_S, check=True)
    found = {}
    for row in done.stdout.decode("utf-8", "replace").splitlines():
        name = row.partition("[")[2].partition("]")[0]
        if row.startswith("NODE") and name:
            station, _, path = name.partition("@")
            full = ".".join([*reversed(path.split(".")), station]) if path else station
            found[full.lower()] = np.array([float(word) for word in row.split()[1:4]])
    return found


def by_cavern(folder, text, name):
    (folder / f"{name}.svx").write_text(text)
    done = subprocess.run(
        ["cavern", "-q", f"{name}.svx"], cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stdout
    return places(folder / f"{name}.3d")


def by_therion(folder, source, name, system=""):
    stated = f"cs {therion_system(system)}\n" if system else ""
    (folder / "thconfig").write_text(f"{stated}source {source}\nexport model -o {name}.3d -fmt survex\n")
    done = subprocess.run(
        ["therion", "-q"], cwd=folder, capture_output=True, text=True, errors="replace", timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stdout[-500:]
    return places(folder / f"{name}.3d")


def in_survex(folder, old: OldSurvey):
    return by_cavern(folder, "\n".join([*svx_system(old), *svx_of(old).lines, ""]), "again")


def in_therion(folder, old: OldSurvey):
    (folder / "again.th").write_text("\n".join(["encoding utf-8", *th_of(old).lines, ""]))
    return by_therion(folder, "again.th", "again_th", map_system(old))


def assert_same(found, expected, *, fixed):
    assert set(expected) <= set(found)
    start = next(iter(expected))
    # Without a fixed point each program begins where it likes.
    shift = 0.0 if fixed else found[start] - expected[start]
    assert max(np.abs(found[name] - shift - at).max() for name, at in expected.items()) <= SAME_M


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


@CAVERN
def test_a_svx_file_goes_in_and_out_of_survex(tmp_path):
    expected = by_cavern(tmp_path, CAVE, "cave")
    old = read_old(tmp_path / "cave.svx")
    found = in_survex(tmp_path, old)
    assert_same(found, expected, fixed=True)
    again = read_old(tmp_path / "again.svx")
    kept = [(s.start, s.end, s.flags, s.when, s.north.value_deg, s.style) for s in old.shots]
    assert sorted(map(str, kept)) == sorted(
        str((s.start, s.end, s.flags, s.when, s.north.value_deg, s.style)) for s in again.shots
    )
    assert again.passages == old.passages
    assert again.surveys == old.surveys


@CAVERN
@THERION
def test_a_svx_file_goes_out_to_therion(tmp_path):
    expected = by_cavern(tmp_path, CAVE, "cave")
    assert_same(in_therion(tmp_path, read_old(tmp_path / "cave.svx")), expected, fixed=True)


@CAVERN
@THERION
@pytest.mark.parametrize("system", ["", "UTM33"])
def test_a_th_file_goes_in_and_out_of_both(tmp_path, system):
    text = TH.replace('station 1 "mouth"', f'cs {system}\n    fix 1 420000 5260000 50\n    station 1 "mouth"')
    (tmp_path / "cave.th").write_text(text if system else TH)
    expected = by_therion(tmp_path, "cave.th", "cave", system)
    old = read_old(tmp_path / "cave.th")
    assert_same(in_therion(tmp_path, old), expected, fixed=bool(system))
    assert_same(in_survex(tmp_path, old), expected, fixed=bool(system))


@pytest.mark.slow
@THERION
@pytest.mark.skipif(not SAMPLES.is_dir(), reason="therion's samples are not installed")
def test_therion_s_samples_go_in_and_out_of_both(tmp_path):
    seen = 0
    for sample in [*sorted(SAMPLES.rglob("*.th")), *sorted(SAMPLES.rglob("*.svx"))]:
        folder = tmp_path / f"{sample.parent.name}_{sample.name}"
        shutil.copytree(sample.parent, folder)
        if not re.search(r"^\s*\*?data |^\s*\d+\s+\d+\s", sample.read_text(encoding="latin-1"), re.MULTILINE):
            # Some have drawings alone.
            continue
        old = read_old(folder / sample.name)
        seen += 1
        if sample.suffix == ".th":
            expected = by_therion(folder, sample.name, "first")
        else:
            expected = by_cavern(folder, sample.read_text(), "first")
        assert_same(in_survex(folder, old), expected, fixed=bool(old.fixes))
        assert_same(in_therion(folder, old), expected, fixed=bool(old.fixes))
    assert seen > 5


@CAVERN
def test_the_adjustment_of_an_old_survey_is_cavern_s(tmp_path):
    expected = by_cavern(
        tmp_path,
        CAVE.replace("diving", "normal").replace("fromdepth todepth", "clino", 1).replace("310 3.0 5.5", "310 -11"),
        "cave",
    )
    old = read_old(tmp_path / "cave.svx")
    project = joined(Project(), [old])
    adjusted = adjust(project)
    same_as = same_place(project, [old])
    ours = {name: adjusted.positions[same_as(name)].position_m for name in old.stations}
    assert_same({name.lower(): at for name, at in ours.items()}, expected, fixed=True)
    # Two loops: three legs in feet, and there and back.
    assert len(adjusted.loops) == 2


@CAVERN
@pytest.mark.parametrize("first", ["old", "new"])
def test_new_legs_hang_on_an_old_survey_in_one_adjustment(tmp_path, first):
    course = world.loop(np.random.default_rng(6), 12)
    rows = world.readings_of(course, np.random.default_rng(2))
    rows = [replace(leg, turn_deg=0.0) for leg in rows]
    old = named(read(tmp_path, CAVE), "cave")
    pair = ["cave.stream.3", "4"] if first == "old" else ["4", "cave.stream.3"]
    project = joined(replace(world.project_of(rows), equate=[Equate(stations=pair)]), [old])
    adjusted = adjust(project)
    assert not adjusted.left_out
    assert len(adjusted.loops) == 3
    sheet = Sheet(project, adjusted, [old])
    found = by_cavern(tmp_path, survex.svx(sheet), "both")
    for name, position in adjusted.positions.items():
        key = name if "." in name else f"demo.{name}"
        assert np.abs(found[key] - position.position_m).max() <= 0.02, name
    # The new end has the old survey's uncertainty as well.
    assert adjusted.positions["10"].ellipse[0] > adjusted.positions[pair[0]].ellipse[0] > 0.0
    assert "again" not in found
    text = survex.th(sheet)
    assert "survey cave" in text
    assert ("equate 4@demo 3@stream.cave" in text) == (first == "new")


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


@pytest.mark.parametrize(("text", "said"), BAD_TH.values(), ids=BAD_TH)
def test_bad_th_is_refused_by_file_line_and_value(tmp_path, text, said):
    with pytest.raises(BuddylineError) as refused:
        read(tmp_path, text, "cave.th")
    assert said in str(refused.value)


# Compass has feet, its own corrections and backsights, and names that are no names elsewhere.
DAT = """\
Old Cave
SURVEY NAME: A
SURVEY DATE: 10 13 1986  COMMENT:low water
SURVEY TEAM:
Ann Diver, Bo Fin
DECLINATION: 4.00  FORMAT: DDDDLRUDLADadBF  CORRECTIONS: 1.00 0.50 0.10

FROM TO LENGTH BEARING INC LEFT UP DOWN RIGHT AZM2 INC2 FLAGS COMMENTS

A1 A2 32.90 45.00 -10.00 1.00 2.00 3.00 4.00 226.00 10.50 wide
A2 B! 20.00 -999.00 5.00 -9.90 -9.90 -9.90 -9.90 100.00 -999.00 #|PL#
A2 X 20.00 10.00 5.00 1.00 1.00 1.00 1.00 -999.00 -999.00 #|X#
"""
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


@CAVERN
def test_compass_data_go_out_to_survex(tmp_path):
    # Of a .dat file Survex 1.4.4 reads neither corrections nor backsights.
    plain = DAT.replace("1.00 0.50 0.10", "0.00 0.00 0.00").replace("DDDDLRUDLADadBF", "DDDDLRUDLAD")
    plain = plain.replace("226.00 10.50 ", "").replace("-999.00 5.00", "280.00 5.00").replace("100.00 -999.00 ", "")
    (tmp_path / "cave.dat").write_text(plain)
    done = subprocess.run(
        ["cavern", "-q", "cave.dat"], cwd=tmp_path, capture_output=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0
    expected = {name: at for name, at in places(tmp_path / "cave.3d").items() if name != "x"}
    assert_same(in_survex(tmp_path, read_old(tmp_path / "cave.dat")), expected, fixed=False)


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


def run(*words):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(word) for word in words]))


def test_the_command_takes_old_surveys_into_a_project(tmp_path, capsys):
    (tmp_path / "cave.svx").write_text(CAVE)
    (tmp_path / "side.th").write_text(TH)
    path = tmp_path / "all.toml"
    assert run("import", path, tmp_path / "cave.svx") == 0
    assert "cave.svx as cave: 10 shots, 1 splays" in capsys.readouterr().out
    with path.open("a") as file:
        file.write('\n[[equate]]\nstations = ["cave.stream.5", "side.cave.1"]\n')
    with pytest.raises(BuddylineError, match=r"side\.cave\.1"):
        run("adjust", path)
    kept = path.read_text()
    assert run("import", path, tmp_path / "side.th") == 0
    assert path.with_name("all.toml.1").read_text() == kept
    assert [one.name for one in load_project(path).old] == ["cave", "side"]
    assert run("adjust", path) == 0
    assert "15 legs" in capsys.readouterr().out
    assert run("export", path, "--format", "stations", "-o", "-") == 0
    rows = capsys.readouterr().out.splitlines()
    assert any(row.startswith("side.cave.side.c,station") for row in rows)
    with pytest.raises(BuddylineError, match="two old surveys have it"):
        run("import", path, tmp_path / "side.th")
    with pytest.raises(BuddylineError, match="no reader"):
        run("import", path, tmp_path / "other.xyz")


def test_edits_take_an_old_leg_out(tmp_path):
    (tmp_path / "cave.svx").write_text(CAVE)
    path = tmp_path / "all.toml"
    assert run("import", path, tmp_path / "cave.svx") == 0
    with path.open("a") as file:
        file.write('\n[[edit]]\nleg = "cave.stream.3-cave.stream.1"\nuse = false\n')
    assert run("adjust", path) == 0
    path.write_text(path.read_text().replace("stream.3-", "stream.33-"))
    with pytest.raises(BuddylineError, match="nor in the old surveys"):
        run("adjust", path)


@CAVERN
def test_the_magnetic_model_of_an_old_survey_is_that_of_its_year(tmp_path):
    text = (
        "*date 2015.08.01\n*cs UTM33N\n*cs out UTM33N\n*fix 0 328000 5260000 2500\n"
        "*declination auto 328000 5260000 2500\n0 1 1000 356.9275 0\n"
    )
    expected = by_cavern(tmp_path, text, "cave")["1"]
    old = named(read_old(tmp_path / "cave.svx"), "cave")
    found = adjust(joined(Project(), [old])).positions["cave.1"].position_m
    # Survex has the IGRF: 0.02 degrees from the World Magnetic Model there and then.
    assert np.abs(found - expected).max() < 0.5
