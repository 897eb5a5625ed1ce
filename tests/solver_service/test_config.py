"""Which pairs are solved."""

import pytest
from buddyline.protocol.codec import encode
from buddyline.protocol.config import ConfigError
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import FixedPlace
from buddyline.solver_service.config import load_solver_config, node_ids
from msgspec.structs import replace

from tests.fuzz.samples import SOUND


def load(tmp_path, text):
    path = tmp_path / "solver.toml"
    path.write_text(text)
    return load_solver_config(path)


def test_all_pairs_unless_nodes_or_pairs_are_named(tmp_path):
    assert load(tmp_path, "").chosen is None
    assert load(tmp_path, 'nodes = ["b", "a", "c"]').chosen == [("b", "a"), ("b", "c"), ("a", "c")]
    assert load(tmp_path, 'pairs = [["c", "a"], ["b", "c"]]').chosen == [("c", "a"), ("b", "c")]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('nodes = ["a"]', "two or more"),
        ('nodes = ["a", "b", "a"]', "different"),
        ('pairs = [["a", "a"]]', "different ids"),
        ('pairs = [["a", "b"], ["b", "a"]]', "once"),
        ('pairs = [["a", "b", "c"]]', "pairs"),
        ('nodes = ["a", "b"]\npairs = [["a", "b"]]', "one of them"),
    ],
)
def test_what_cannot_be_solved_is_named(tmp_path, text, says):
    with pytest.raises(ConfigError, match=says):
        load(tmp_path, text)


def test_nodes_of_the_command_line():
    assert node_ids(["a,b", "c"]) == ["a", "b", "c"]
    for words in (["a"], ["a", "a"], ["a,B"]):
        with pytest.raises(BuddylineError, match=r"different|node id"):
            node_ids(words)


def test_lamps_alone_come_from_files_beside_the_configuration(tmp_path):
    fixed = FixedPlace(p_m=(0.0, 0.0, 0.0), q_xyzw=(0.0, 0.0, 0.0, 1.0), sigma_m=0.1, sigma_rad=0.1)
    info = replace(SOUND[0], node="c", role="lights", fixed=fixed)
    (tmp_path / "c.json").write_bytes(encode(info))
    (named,) = load(tmp_path, 'lights = ["c.json"]').lamps_alone()
    assert (named.node, named.fixed) == ("c", fixed)
    with pytest.raises(ConfigError, match=r"c\.json: node c is named twice"):
        load(tmp_path, 'lights = ["c.json", "c.json"]').lamps_alone()
    with pytest.raises(ConfigError, match=r"lights: .*d\.json: cannot be read"):
        load(tmp_path, 'lights = ["d.json"]').lamps_alone()
    (tmp_path / "c.json").write_bytes(encode(replace(info, role="full")))
    with pytest.raises(ConfigError, match=r'c\.json: node c has not role "lights"'):
        load(tmp_path, 'lights = ["c.json"]').lamps_alone()
