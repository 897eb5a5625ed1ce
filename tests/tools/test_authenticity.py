"""`solve`, `backfill` and `report` say whether logs are what their nodes wrote."""

from __future__ import annotations

from pathlib import Path

import pytest
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.tools.cli import main

from tests.protocol.test_digest import Line, written
from tests.tools.identities import make_keys


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_keys(tmp_path_factory.mktemp("keys"), "a", "b")


def log_of(path: Path, lines: list[Line]) -> str:
    with DiveLogWriter(path) as writer:
        for key, payload, time_ns in lines:
            writer.write(key, payload, time_ns)
    return str(path)


def backfill(path: Path, *logs: str, authority: Path | None = None) -> int:
    words = [] if authority is None else ["--authority", str(authority / "ca.crt")]
    return main(["backfill", *logs, "-o", str(path), *words])


def test_backfill_names_what_was_altered(keys: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    lines = written("a", keys)
    own, topside = log_of(tmp_path / "a.mcap", lines), log_of(tmp_path / "top.mcap", lines[:40])
    assert backfill(tmp_path / "whole.mcap", topside, own, authority=keys) == 0
    key, payload, time_ns = lines[30]
    lines[30] = key, payload.replace(b".0", b".5", 1), time_ns
    capfd.readouterr()
    assert backfill(tmp_path / "x.mcap", topside, log_of(tmp_path / "forged.mcap", lines), authority=keys) == 1
    assert "forged.mcap: node a: is not what the node wrote" in capfd.readouterr().err


def test_an_authority_that_is_none_is_named_first(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    topside, own = (log_of(tmp_path / f"{name}.mcap", []) for name in ("top", "a"))
    words = ["backfill", topside, own, "-o", str(tmp_path / "x.mcap"), "--authority", str(tmp_path / "none.crt")]
    assert main(words) == 2
    assert "none.crt: cannot be read: No such file or directory" in capfd.readouterr().err
    (tmp_path / "none.crt").write_text("no certificate")
    assert main(words) == 2
    assert "none.crt: is not a certificate in PEM" in capfd.readouterr().err


def test_a_log_without_digests_is_named_where_an_authority_is(keys: Path, tmp_path: Path) -> None:
    lines = [line for line in written("a", keys) if not line[0].endswith("/digest")]
    own, topside = log_of(tmp_path / "a.mcap", lines), log_of(tmp_path / "top.mcap", lines[:10])
    assert backfill(tmp_path / "one.mcap", topside, own) == 0
    assert backfill(tmp_path / "two.mcap", topside, own, authority=keys) == 1
