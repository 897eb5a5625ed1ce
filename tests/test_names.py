"""A type name stands for one thing in the whole project."""

import ast
from collections import defaultdict

from tests.imports import modules
from tests.processes import REPOSITORY


def classes(root):
    """Return the modules that define a class, the tests' too, by its name without a leading underscore."""
    found = defaultdict(set)
    tests = {".".join(path.relative_to(root).with_suffix("").parts): path for path in (root / "tests").rglob("*.py")}
    for module, path in (modules(root) | tests).items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                found[node.name.lstrip("_")].add(module)
    return found


def doubles(root):
    """Return the names that two modules give to a class."""
    return {name: sorted(where) for name, where in classes(root).items() if len(where) > 1}


def test_no_class_name_stands_for_two_things():
    assert doubles(REPOSITORY) == {}, "choose another name: one class name, one thing"


def test_a_duplicate_class_name_is_found(tmp_path):
    for folder, text in (
        ("node", "class Light:\n    pass\n"),
        ("tests", "class Light:\n    pass\n"),
        ("tools", "def f():\n    class _Light:\n        pass\n"),
    ):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "lamp.py").write_text(text)
    assert doubles(tmp_path) == {"Light": ["buddyline.node.lamp", "buddyline.tools.lamp", "tests.lamp"]}
