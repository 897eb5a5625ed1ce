"""`buddyline align` where a dive does not tell the clocks' offset: it says why, and advises nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.messages import Candidates, NodeInfo
from buddyline.tools.cli import main
from buddyline.tools.dives import Dive
from msgspec.structs import replace


@pytest.fixture(scope="module")
def resting(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dive in which both nodes hold still."""
    path = tmp_path_factory.mktemp("align") / "rest.mcap"
    assert main(["simulate", str(path), "--trajectory", "rest", "--seconds", "6"]) == 0
    return path


def test_a_pair_that_rests_tells_no_offset(
    resting: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """Its fixes give one, but with a sigma that is no better than not knowing it."""
    assert main(["align", str(resting)]) == 1
    assert capsys.readouterr().out == ""
    assert "do not tell the offset within 50 ms" in caplog.text


@pytest.mark.parametrize(
    ("lacks", "said"),
    [
        (NodeInfo, "no NodeInfo of node a; name a log that has it, too"),
        (Candidates, "no fix tells the clocks' offset ("),
    ],
)
def test_a_dive_without_fixes_says_what_is_missing(
    resting: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], lacks: type, said: str
) -> None:
    silent = tmp_path / "silent.mcap"
    with Dive([resting]) as dive, DiveLogWriter(silent) as writer:
        for envelope in dive.messages():
            message = envelope.message
            if isinstance(message, Candidates):
                message = replace(message, blobs=[] if lacks is Candidates else message.blobs)
            if not isinstance(message, lacks) or lacks is Candidates:
                writer.write_message(message, envelope.time_ns, key=envelope.key)
    assert main(["align", str(silent)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert lacks is NodeInfo or "too_few_candidates" in error
