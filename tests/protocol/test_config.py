"""Configuration: strict, and errors name file, field and value."""

from datetime import datetime

import pytest
from buddyline.node.config import NodeConfig
from buddyline.protocol.config import LONG, Config, ConfigError, config_sha256, load_config, parse_config
from buddyline.solver_service.config import SolverConfig
from buddyline.tools.client import ClientConfig
from buddyline.tools.hub import HubConfig


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('node = "a"\n[camera]\nwidht_px = 3\n', ["camera", "widht_px", "width_px"]),
        ('node = "a"\nnmae = 1\n', ["nmae", "node"]),
        ('node = "a/b"\n', ["node", "'a/b'"]),
        ('node = "a"\nrate_hz = "ten"\n', ["rate_hz", "'ten'"]),
        ('node = "a"\nrate_hz = -1.0\n', ["rate_hz", "-1.0"]),
        ('node = "a"\nrate_hz = 1e-300\n', ["rate_hz", "1e-300"]),
        ('node = "a"\nnamespace = "a//b"\n', ["namespace", "'a//b'"]),
        ('node = "a"\nnamespace = "a/*"\n', ["namespace", "'a/*'"]),
        ('node = "a"\nnamespace = "/a"\n', ["namespace", "'/a'"]),
        ("rate_hz = 1.0\n", ["node"]),
        ('node = "a\n', ["not TOML"]),
    ],
)
def test_errors_name_field_and_value(text, says):
    with pytest.raises(ConfigError) as refused:
        parse_config(text, NodeConfig, "a.toml")
    for word in ["a.toml", *says]:
        assert word in str(refused.value)


class Times(Config, frozen=True, kw_only=True):
    time: list[datetime]
    text: str


def test_a_long_text_is_read_as_a_short_one(monkeypatch):
    rtoml = pytest.importorskip("rtoml")
    text = 'time = [2026-05-01T10:20:30Z, 2026-05-01T10:20:30.5+02:00]\ntext = """\nm\\u00e9tre\n"""\n'
    short = parse_config(text, Times, "a.toml")
    assert short.text == "m\u00e9tre\n"
    assert parse_config(text + "#" * LONG, Times, "a.toml") == short
    refused = []
    for end in ("", "#" * LONG):
        with pytest.raises(ConfigError, match=r"a\.toml: not TOML: .* line 5, column") as error:
            parse_config(text + "text = 2\n" + end, Times, "a.toml")
        refused.append(str(error.value))
    assert refused[0] == refused[1]
    monkeypatch.setattr(rtoml, "loads", lambda text: {"time": [], "text": "by rtoml"})
    assert parse_config(text + "#" * LONG, Times, "a.toml").text == "by rtoml"


def test_a_missing_configuration_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.toml"):
        load_config(tmp_path / "none.toml", NodeConfig)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"\x89MCAP0\r\nlog", "a.toml: is a dive log; name a configuration in TOML here"),
        (
            b'node = "a"\nconnect = "\xe9"\n',
            "a.toml: byte 0xe9 in line 2 is not UTF-8 text; name a configuration in TOML, saved as UTF-8",
        ),
    ],
)
def test_a_file_that_is_no_text_is_named_with_what_is_wanted(tmp_path, content, says):
    (tmp_path / "a.toml").write_bytes(content)
    with pytest.raises(ConfigError) as refused:
        load_config(tmp_path / "a.toml", NodeConfig)
    assert str(refused.value) == f"{tmp_path}/{says}"


def test_lines_may_end_as_on_windows(tmp_path):
    (tmp_path / "a.toml").write_bytes(b'\xef\xbb\xbfnode = "a"\r\nrate_hz = 5.0\r\n')
    assert load_config(tmp_path / "a.toml", NodeConfig).rate_hz == 5.0


@pytest.mark.parametrize("schema", [ClientConfig, HubConfig, SolverConfig])
def test_a_namespace_that_is_no_part_of_a_key_is_refused(schema):
    assert parse_config('namespace = "pool/lane-2"', schema, "a.toml").namespace == "pool/lane-2"
    with pytest.raises(ConfigError, match="namespace = 'a/'"):
        parse_config('namespace = "a/"', schema, "a.toml")


def test_defaults_apply_and_change_the_hash_when_overridden():
    config = parse_config('node = "a"', NodeConfig, "a.toml")
    assert config.camera.name == "simulated"
    assert config_sha256(config) == config_sha256(NodeConfig(node="a"))
    assert config_sha256(config) != config_sha256(NodeConfig(node="b"))
