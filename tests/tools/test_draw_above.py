"""The view from above: who stands where, who looks where, and how far it is."""

import math
import re

import pytest
from buddyline.tools.draw.above import ASCII_ARROWS, from_above, nodes_from_above


def place(lines, name):
    return next((row, line.index(name)) for row, line in enumerate(lines) if name in line)


def row_m(lines):
    return float(re.search(r"a row is (\S+) m", lines[-1])[1])


def test_b_stands_before_a_and_looks_back():
    lines = from_above(40, 9, 0.0, 4.0, math.pi)
    (a_row, a_column), (b_row, b_column) = place(lines, "A"), place(lines, "B")
    assert a_column == b_column
    assert (a_row - b_row) * row_m(lines) == pytest.approx(4.0, abs=row_m(lines) / 2)
    assert lines[a_row][a_column + 1] == "↑"
    assert lines[b_row][b_column + 1] == "↓"
    assert "." in lines[a_row - 1]


def test_right_is_right_and_a_character_is_half_a_row_wide():
    lines = from_above(60, 9, 3.0, 3.0, -math.pi / 2)
    (a_row, a_column), (b_row, b_column) = place(lines, "A"), place(lines, "B")
    assert (b_column - a_column) / 2 == pytest.approx(a_row - b_row, abs=1)
    assert lines[b_row][b_column + 1] == "←"


def test_behind_a_is_below_it():
    lines = from_above(40, 9, 0.0, -4.0, 0.0)
    assert place(lines, "B") > place(lines, "A")


@pytest.mark.parametrize("size", [(60, 14), (20, 4), (200, 50)])
@pytest.mark.parametrize("right_m", [-300.0, -2.0, 0.0, 0.01, 40.0])
def test_all_stays_on_the_page(size, right_m):
    lines = from_above(*size, right_m, 5.0, 1.0, arrows=ASCII_ARROWS)
    assert len(lines) == max(size[1], 3)
    assert all(len(line) <= max(size[0], 28) for line in lines)
    assert all(character.isascii() for line in lines for character in line)
    assert any("A" in line for line in lines)
    assert any("B" in line for line in lines)


def test_any_number_of_nodes_stands_with_north_up():
    nodes = [
        ("a", 0.0, 0.0, 0.0),
        ("b", 8.0, 0.0, math.pi),
        ("c", 0.0, 6.0, -math.pi / 2),
        ("d", 8.0, 6.0, math.pi / 2),
    ]
    *page, scale = nodes_from_above(40, 10, nodes, arrows=ASCII_ARROWS)
    assert (len(page), scale) == (9, "from above, north up; a row is 1 m")
    assert page[0].split() == ["bv", "d>"]
    assert page[8].split() == ["a^", "c<"]
    assert page[8].index("c") - page[8].index("a") == 12
    assert nodes_from_above(40, 4, nodes[:1])[:-1].count("") == 2
