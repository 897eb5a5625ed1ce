"""docs/troubleshooting.md has an entry for each reason, finding and alarm that the programs know."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest
from buddyline.protocol.messages import Reason
from buddyline.solver_service.pace import NO_NETWORK, NO_TRACK, ONE_IN_FIVE
from buddyline.solver_service.resting import NO_TIME
from buddyline.tools.health.words import REASONS

from tests.processes import REPOSITORY

PAGE = REPOSITORY / "docs" / "troubleshooting.md"


def calls(folder: str, function: str) -> Iterator[ast.Call]:
    """Yield the calls of a function in the modules of a folder."""
    for path in sorted((REPOSITORY / folder).glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == function:
                yield node


def findings() -> set[str]:
    """Return the names of all findings: the first argument where it is a constant."""
    found = set()
    for folder in ("tools/health", "tools/doctor"):
        for call in calls(folder, "Finding"):
            if call.args and isinstance(call.args[0], ast.Constant):
                found.add(str(call.args[0].value))
    return found


def alarms() -> set[str]:
    """Return the checks of all survey alarms: texts that begin with `check: `."""
    found = set()
    for name in ("alarms", "derive"):
        text = (REPOSITORY / "tools" / "survey" / f"{name}.py").read_text()
        found |= set(re.findall(r'f?"([a-z]+): ', text))
    return found


def entries(page: Path = PAGE) -> set[str]:
    """Return the words in code of the first column of all tables."""
    rows = [line for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    return {word for row in rows for word in re.findall(r"`([^`]+)`", row.split("|")[1])}


def test_each_reason_of_a_rejection_has_an_entry() -> None:
    assert set(get_args(Reason)) <= entries()
    assert set(get_args(Reason)) == set(REASONS), "each is said in words on the screen as well"


def test_each_finding_has_an_entry() -> None:
    assert len(findings()) > 15
    assert findings() <= entries()


def test_each_alarm_of_a_survey_has_an_entry() -> None:
    assert len(alarms()) > 5
    assert alarms() <= entries() | {"ALARM"}


def test_each_text_of_a_solver_that_cannot_keep_up_has_an_entry() -> None:
    for said in (NO_TRACK, NO_NETWORK):
        assert said.split(":")[0] in entries()
    assert "the solver is 2 s behind: this machine is too slow" in entries()
    whole = PAGE.read_text(encoding="utf-8")
    assert all(word in whole for word in re.findall(r"one in \w+", f"{NO_TIME} {ONE_IN_FIVE}"))


def problems() -> set[str]:
    """Return what tracks and networks say is wrong: the texts with values in them, {} in each one's place."""
    found = set()
    for folder in ("track", "network"):
        for path in sorted((REPOSITORY / "solver_service" / folder).glob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.JoinedStr):
                    parts = [str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values]
                    found.add("".join(parts))
    # The rest names nodes, or is a part of one of these.
    return {text for text in found if len(text.split()) > 3 and ("{}:" in text or "contradict" in text)}


def test_each_problem_of_a_track_or_a_network_has_an_entry() -> None:
    texts = problems()
    assert len(texts) > 14
    assert [text for text in texts if not any(entry in text for entry in entries())] == []


@pytest.mark.parametrize("word", ["range_gap", "compass", "sights"])
def test_a_missing_entry_would_be_found(word: str, tmp_path: Path) -> None:
    shorter = tmp_path / "page.md"
    shorter.write_text("".join(line for line in PAGE.read_text().splitlines(True) if f"`{word}`" not in line))
    assert word not in entries(shorter)
