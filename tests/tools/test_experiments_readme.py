"""The README's table of accuracy belongs to the code that stands beside it."""

from pathlib import Path

import pytest
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.cli import main
from buddyline.tools.experiments.numbers import README_ROWS
from buddyline.tools.experiments.readme import (
    COMMAND,
    deciding_hash,
    deciding_modules,
    read_readme,
    with_table,
    written_hash,
)

README = Path(__file__).parents[2] / "README.md"
SOURCE = '''
"""What it does."""
import math
from a import b

class Light:
    """One light."""
    def far(self, range_m: float = 2.0) -> bool:
        """Whether it is far."""
        return math.hypot(range_m, 1.0) > 3.0
'''


def test_the_readme_table_was_measured_with_this_code():
    assert written_hash(README.read_text()) == deciding_hash(), (
        f"the table in README.md is older than what decides poses (detector or solver); write it anew: {COMMAND}"
    )


def test_the_readme_has_the_main_rows_of_the_headline():
    table = README.read_text().partition("accuracy of code")[2].partition("end of accuracy")[0]
    rows = [line for line in table.splitlines() if line.startswith("| ")][2:]
    assert [row.startswith(f"| {name}") for row, name in zip(rows, README_ROWS, strict=True)] == [True] * len(rows)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("One light.", "A lamp."),
        ("import math\n", "import math  # the library\n"),
        ("from a import b", "from c.a import b"),
        ("return math", "# far away\n        return math"),
        ('        """Whether it is far."""\n', ""),
        ("(range_m, 1.0)", "(range_m,\n            1.0)"),
    ],
)
def test_comments_and_docstrings_do_not_change_the_hash(old, new):
    assert old in SOURCE
    assert deciding_hash([SOURCE.replace(old, new)]) == deciding_hash([SOURCE])


@pytest.mark.parametrize(
    ("old", "new"),
    [("3.0", "3.1"), ("> 3", ">= 3"), ("= 2.0", "= 2.5"), ("hypot", "dist"), ("range_m, 1.0", "1.0, range_m")],
)
def test_deciding_code_changes_the_hash(old, new):
    assert old in SOURCE
    assert deciding_hash([SOURCE.replace(old, new)]) != deciding_hash([SOURCE])


def test_moved_or_renamed_modules_do_not_change_the_hash():
    assert deciding_hash([SOURCE, "x = 1"]) == deciding_hash(["x = 1", SOURCE])
    assert deciding_hash([SOURCE]) != deciding_hash([SOURCE, "x = 1"])


def test_the_hash_covers_detector_and_solver():
    names = {f"{path.parent.name}/{path.name}" for path in deciding_modules()}
    assert {"detect/centre.py", "geometry/trigger.py", "solver_service/core.py", "node/pipeline.py"} <= names
    assert not any(name.startswith(("tools/", "protocol/", "sim/", "drivers/")) for name in names)


def test_the_table_is_written_between_its_markers_alone():
    text = "# Us\n\n<!-- accuracy of code 0123456789abcdef, x -->\n| old |\n<!-- end of accuracy -->\n\nmore\n"
    new = with_table(text, "| new \\1 |\n", "fedcba9876543210")
    assert written_hash(new) == "fedcba9876543210"
    assert new.startswith("# Us\n\n<!-- accuracy of code fedcba9876543210, written by `")
    assert new.endswith("-->\n| new \\1 |\n<!-- end of accuracy -->\n\nmore\n")


def test_a_readme_without_a_place_for_the_table_is_refused_before_the_run(tmp_path, capsys):
    path = tmp_path / "README.md"
    with pytest.raises(BuddylineError, match=r"README\.md: cannot be read"):
        read_readme(path)
    path.write_text("# Us\n")
    assert main(["experiments", "-o", str(tmp_path / "report"), "--readme", str(path)]) == 2
    assert "has no table between" in capsys.readouterr().err
    assert main(["experiments", "-o", str(tmp_path / "report"), "--readme", str(README), "--quick"]) == 2
    assert "a quick run gives no figures to quote" in capsys.readouterr().err
    assert not (tmp_path / "report").exists()
