"""One old cave in the languages of three programs, and how a test reads it."""

from buddyline.tools.survey.old.readers import read_old

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
