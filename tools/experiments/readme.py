"""The README's table of accuracy. A command writes it, with the hash of the code that was measured."""

from __future__ import annotations

import ast
import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from buddyline.protocol.errors import BuddylineError

COMMAND: Final = "buddyline experiments -o report/ --readme README.md"
# The solver's modules that pass poses on and do not decide them.
_CARRY: Final = ("__main__.py", "answered.py", "health.py", "journal.py", "service.py")
_MARKED: Final = re.compile(r"<!-- accuracy of code ([0-9a-f]{16}),.*?-->\n(.*?)<!-- end of accuracy -->\n", re.DOTALL)


def deciding_modules() -> list[Path]:
    """Return the source files of the code that decides a pose: the detector, a node's pipeline, and the solver."""
    from buddyline import node, solver_service

    node_folder, solver_folder = (Path(str(package.__file__)).parent for package in (node, solver_service))
    solver = [path for path in solver_folder.rglob("*.py") if path.relative_to(solver_folder).name not in _CARRY]
    return sorted([*(node_folder / "detect").rglob("*.py"), node_folder / "pipeline.py", *solver])


def deciding_hash(sources: list[str] | None = None) -> str:
    """Return the hash, 16 hex digits, of the code that decides poses. sources: texts in place of the installed ones.

    Comments, docstrings, imports, formatting and the modules' names and order do not count: none changes a pose.
    """
    if sources is None:
        sources = [path.read_text(encoding="utf-8") for path in deciding_modules()]
    each = sorted(hashlib.sha256("".join(_tokens(ast.parse(text))).encode()).hexdigest() for text in sources)
    return hashlib.sha256("".join(each).encode()).hexdigest()[:16]


def _tokens(node: ast.AST) -> Iterator[str]:
    """Yield a tree's nodes and values. Fields without a value are left out: Python's versions differ in them."""
    yield f"({type(node).__name__}"
    for name, value in ast.iter_fields(node):
        values = value if isinstance(value, list) else [value]
        if name == "body":
            values = [one for one in values if not _says_nothing(one)]
        if values and values != [None]:
            yield f" {name}="
            for one in values:
                yield from _tokens(one) if isinstance(one, ast.AST) else (f"{one!r},",)
    yield ")"


def _says_nothing(statement: object) -> bool:
    """Return whether a statement is a docstring (or another bare text) or an import."""
    text = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
    return text or isinstance(statement, ast.Import | ast.ImportFrom)


def written_hash(readme: str) -> str:
    """Return the hash in a README's table; raise BuddylineError if it has no such table."""
    found = _MARKED.search(readme)
    if found is None:
        raise BuddylineError("README: has no table between <!-- accuracy of code ... --> and <!-- end of accuracy -->")
    return found[1]


def with_table(readme: str, table: str, code_hash: str) -> str:
    """Return a README's text with a new table (Markdown lines) and hash between its two markers."""
    written_hash(readme)
    marked = f"<!-- accuracy of code {code_hash}, written by `{COMMAND}` -->\n{table}<!-- end of accuracy -->\n"
    return _MARKED.sub(lambda _: marked, readme, count=1)


def read_readme(path: Path) -> str:
    """Return the text of a README; raise BuddylineError, naming the file, if it has no place for the table."""
    try:
        text = path.read_text(encoding="utf-8")
        written_hash(text)
    except OSError as error:
        raise BuddylineError(f"{path}: cannot be read: {error.strerror}") from error
    except BuddylineError as error:
        raise BuddylineError(f"{path}: {error}") from None
    return text
