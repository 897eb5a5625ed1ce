"""Which pairs are solved."""

import pytest
from buddyline.protocol.config import ConfigError
from buddyline.protocol.errors import BuddylineError
from buddyline.solver_service.config import load_solver_config, node_ids


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
