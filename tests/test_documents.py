"""What the documents name is there: files they link to, commands and options, modules, targets of make, extras."""

from __future__ import annotations

import argparse
import importlib.util
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from buddyline import read_info
from buddyline.tools.cli import COMMANDS

from tests.processes import REPOSITORY

DOCUMENTS = sorted(
    path
    for path in REPOSITORY.rglob("*.md")
    if not any(part.startswith(".") or part in ("build", "node_modules") for part in path.relative_to(REPOSITORY).parts)
)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
PROGRAM = re.compile(r"^(?:sudo |! |\S+ run )?(?:\.venv/bin/)?buddyline(?= |$)(.*)$")
MODULE = re.compile(r"python3? -m ([\w.]+)")
TARGET = re.compile(r"^make ((?:[A-Z]+=\S+ )*)([a-z][\w-]*)")
EXTRAS = re.compile(r"EXTRAS=([\w,]+)")
COMMAND = {command.name: command for command in COMMANDS}


def said(text: str) -> Iterator[str]:
    """Yield the code of a document: lines of code blocks, and code within sentences."""
    fenced = False
    prose: list[str] = []
    for line in text.splitlines():
        if line.lstrip().startswith("```"):
            fenced = not fenced
        elif fenced or line.startswith("    "):
            yield from re.split(r" & |&& | \| ", line.strip())
        else:
            prose.append(line)
    yield from re.findall(r"`([^`]+)`", " ".join(prose))


def unknown(words: list[str], parser: argparse.ArgumentParser) -> list[str]:
    """Return the options, and the subcommand, that a parser does not know."""
    actions = {name: action for action in parser._actions for name in action.option_strings}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            chosen = next((word for word in words if word in action.choices), None)
            if chosen is not None:
                actions |= {name: one for one in action.choices[chosen]._actions for name in one.option_strings}
            elif words and not words[0].startswith("-"):
                return [words[0]]
    return [word for word in words if re.match(r"--?[a-z]", word) and word.partition("=")[0] not in actions]


def wrong(text: str) -> list[str]:
    """Return the missing things that a document names, a line each."""
    found = []
    extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    targets = set(re.findall(r"^([a-z]+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE))
    for code in said(text):
        line = code.partition("  #")[0].strip()
        if match := PROGRAM.match(line):
            words = [word for word in shlex.split(match[1].replace("'", "")) if word not in ("...", "&")]
            if words and re.fullmatch(r"[a-z][a-z0-9-]*", words[0]):
                command = COMMAND.get(words[0])
                bad = [words[0]] if command is None else unknown(words[1:], command.parser())
                found += [f"`{line}`: no {word}" for word in bad]
        for module in MODULE.findall(line):
            if module != "venv" and importlib.util.find_spec(module) is None:
                found.append(f"`{line}`: no module {module}")
        if (match := TARGET.match(line)) and match[2] not in targets:
            found.append(f"`{line}`: no target {match[2]}")
        for names in EXTRAS.findall(line):
            found += [f"`{line}`: no extra {name}" for name in names.split(",") if name not in extras]
    return found


def headings(path: Path) -> set[str]:
    """Return the anchors of a document's headings, as GitHub and the site name them."""
    lines = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", line.lower()).replace(" ", "-") for line in lines}


def dead_links(path: Path) -> list[str]:
    """Return the links of a document to files, and to headings in documents, that are not there."""
    targets = LINK.findall(path.read_text(encoding="utf-8"))
    dead = []
    for target in (one for one in targets if "://" not in one and not one.startswith("mailto:")):
        file, _, heading = target.partition("#")
        there = path.parent / file if file else path
        if not there.exists() or (heading and heading not in headings(there)):
            dead.append(target)
    return dead


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_files_and_commands_named_in_documents_exist(path: Path) -> None:
    assert dead_links(path) == []
    assert wrong(path.read_text(encoding="utf-8")) == []


def test_the_readme_links_to_every_other_document() -> None:
    readme = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    linked = {target.partition("#")[0] for target in LINK.findall(readme)}
    assert {f"docs/{path.name}" for path in (REPOSITORY / "docs").glob("*.md")} <= linked
    assert {"CONTRIBUTING.md", "CHANGELOG.md", "node/README.md", "protocol/README.md"} <= linked


def test_the_site_has_every_document() -> None:
    pages = set(re.findall(r'"([\w/]+\.md)"', (REPOSITORY / "docs" / "site" / "make.py").read_text()))
    there = {str(path.relative_to(REPOSITORY)) for path in DOCUMENTS if path.parent.name != "golden"}
    assert there <= pages


def test_the_file_of_a_tripod_in_the_documents_is_read(tmp_path: Path) -> None:
    text = re.search(r"```json\n(.*?)```", (REPOSITORY / "docs" / "network.md").read_text(), re.DOTALL)
    assert text is not None
    (tmp_path / "c.json").write_text(text[1])
    info = read_info(tmp_path / "c.json")
    assert info.fixed
    assert not info.has_camera


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("    buddyline slove a.mcap\n", "no slove"),
        ("`buddyline solve a.mcap --fast`", "no --fast"),
        ("```\nbuddyline keys initt --hub x\n```", "no initt"),
        ("`buddyline keys init --host x`", "no --host"),
        ("`sudo .venv/bin/buddyline node --conf\na.toml`", "no --conf"),
        ("`python -m tests.fuzzy --minutes 1`", "no module tests.fuzzy"),
        ("    make demos\n", "no target demos"),
        ("`make install EXTRAS=keys,moniter`", "no extra moniter"),
    ],
)
def test_a_missing_file_or_command_is_found(text: str, says: str) -> None:
    assert [line.endswith(says) for line in wrong(text)] == [True]


def test_a_dead_link_is_found(tmp_path: Path) -> None:
    (tmp_path / "a.md").write_text(
        "# A: one\n[here](a.md#a-one), [no](#two), [there](b.md#x), [far](https://example.org)\n"
    )
    assert dead_links(tmp_path / "a.md") == ["#two", "b.md#x"]
