"""The imports of the project's modules, read from their syntax: at any place in a module, also for types only."""

import ast
from functools import cache
from pathlib import Path

FOLDERS = {
    "buddyline": "buddyline",
    "protocol": "buddyline.protocol",
    "node": "buddyline.node",
    "solver_service": "buddyline.solver_service",
    "tools": "buddyline.tools",
}


def modules(root: Path) -> dict[str, Path]:
    """Return every module of the distribution, by its import name."""
    found = {}
    for folder, package in FOLDERS.items():
        for path in (root / folder).rglob("*.py"):
            parts = path.relative_to(root / folder).with_suffix("").parts
            found[".".join([package, *parts]).removesuffix(".__init__")] = path
    return found


def imported_by(name: str, path: Path) -> set[str]:
    """Return the absolute names that a module imports; of `from a import b` both a and a.b."""
    return _imported(name, path.name == "__init__.py", path.read_text(encoding="utf-8"))


@cache
def _imported(name: str, is_package: bool, text: str) -> set[str]:
    package = name.split(".") if is_package else name.split(".")[:-1]
    names: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = ".".join([*package[: len(package) - node.level + 1], node.module or ""] if node.level else [])
            base = base.rstrip(".") or node.module or ""
            names |= {base} | {f"{base}.{alias.name}" for alias in node.names}
    return names


def circles(root: Path) -> list[list[str]]:
    """Return the groups of modules that import one another in a circle; what is imported in a function counts, too.

    A package whose __init__ imports its own modules is no circle.
    """
    known = modules(root)
    graph = {
        name: {one for one in imported_by(name, path) & known.keys() if not name.startswith(f"{one}.") and one != name}
        for name, path in known.items()
    }
    groups: list[list[str]] = []
    low: dict[str, int] = {}
    order: dict[str, int] = {}
    stack: list[str] = []

    def visit(name: str) -> None:
        order[name] = low[name] = len(order)
        stack.append(name)
        for other in sorted(graph[name]):
            if other not in order:
                visit(other)
            if other in stack:
                low[name] = min(low[name], low[other])
        if low[name] == order[name]:
            group = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            if len(group) > 1:
                groups.append(sorted(group))

    for name in sorted(graph):
        if name not in order:
            visit(name)
    return groups
