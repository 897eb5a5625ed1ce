"""Make the site of documents: `python docs/site/make.py SITE`. A link to a page that is not there is an error.

The pages lie all over the repository, beside what they describe. They are gathered into SITE.pages, with a page of all
commands that is made from their own help and one of all messages that is made from their code, and Sphinx makes SITE
out of them.
"""

from __future__ import annotations

import argparse
import inspect
import os
import posixpath
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

import msgspec
from buddyline.protocol import messages as kinds
from buddyline.protocol.topics import TOPICS
from buddyline.tools.cli import COMMANDS

REPOSITORY: Final = Path(__file__).resolve().parents[2]
PAGES: Final = {
    "Learn": ["docs/tutorial.md", "docs/install.md", "docs/dives.md", "docs/security.md", "docs/troubleshooting.md"],
    "Use from elsewhere": ["docs/library.md", "docs/bridge.md", "docs/blueos.md", "protocol/README.md"],
    "Build and survey": ["docs/build/README.md", "node/README.md", "docs/pool_day.md", "tools/survey/README.md"],
    "Reference": ["commands", "messages", "docs/glossary.md"],
    "How it works": [
        "docs/theory.md",
        "docs/node.md",
        "docs/track.md",
        "docs/network.md",
        "docs/geodesy.md",
        "docs/decisions.md",
    ],
    "Develop": ["CONTRIBUTING.md", "CHANGELOG.md"],
}
LINK: Final = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#]+)(#[^)\s]*)?\)")


def page_of(path: str) -> str:
    """Return a document's page: `node/README.md` is `node.md`."""
    return "index.md" if path == "README.md" else path.replace("/README.md", ".md").replace("/", "_").lower()


def linked(text: str, source: str, pages: Path) -> str:
    """Return a document with links to pages; pictures come along, and what is neither is named without a link.

    Diagrams stay as text: what draws them in a browser would have to be fetched from elsewhere.
    """
    documents = {"README.md"} | {path for paths in PAGES.values() for path in paths}

    def anew(match: re.Match[str]) -> str:
        picture, words, target, anchor = match[1], match[2], match[3], match[4] or ""
        if "://" in target:
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if path in documents:
            return f"[{words}]({page_of(path)}{anchor})"
        if path.endswith((".png", ".svg", ".jpg")):
            shutil.copy(REPOSITORY / path, pages / path.replace("/", "_"))
            return f"{picture}[{words}]({path.replace('/', '_')})"
        return f"{words} (`{path}`)"

    return LINK.sub(anew, text.replace("```mermaid", "```text"))


def commands() -> str:
    """Return the page of all commands, each with its own help."""
    os.environ["COLUMNS"] = "100"
    said = ["# Commands\n\nAll are parts of one program, `buddyline`. What each says of itself:\n"]
    for one in COMMANDS:
        parser = one.parser()
        said.append(f"## buddyline {one.name}\n\n```text\n{parser.format_help()}```\n")
        for name, part in parts_of(parser).items():
            said.append(f"### buddyline {one.name} {name}\n\n```text\n{part.format_help()}```\n")
    return "\n".join(said)


def parts_of(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of a command's subcommands, by name."""
    return {
        name: part
        for action in parser._actions
        if isinstance(action, argparse._SubParsersAction)
        for name, part in action.choices.items()
    }


def messages() -> str:
    """Return the page of all messages: their keys, what they are, and their fields with types."""
    said = [
        "# Messages\n\nThey are JSON; [the protocol](protocol.md) says how they travel. A field with `UnsetType` may "
        "be missing, and one with `= ...` has this value where it is.\n"
    ]
    structures = [one for one in vars(kinds).values() if inspect.isclass(one) and issubclass(one, msgspec.Struct)]
    for one in sorted(structures, key=lambda each: each.__name__):
        keys = [f"`{topic.template}`" for topic in TOPICS if topic.schema is one]
        travels = f"On {' and '.join(keys)}." if keys else "Part of other messages."
        said.append(
            f"## {one.__name__}\n\n{travels}\n\n```text\n{inspect.getdoc(one)}\n```\n\n| field | type |\n|---|---|"
        )
        for field in msgspec.structs.fields(one):
            written = next(
                str(base.__annotations__[field.name]) for base in one.__mro__ if field.name in base.__annotations__
            )
            default = "" if field.default in (msgspec.NODEFAULT, msgspec.UNSET) else f" = {field.default!r}"
            said.append(f"| `{field.encode_name}` | `{(written + default).replace('|', 'or')}` |")
        said.append("")
    return "\n".join(said)


MADE: Final = {"commands": commands, "messages": messages}


def gather(pages: Path) -> None:
    """Write all pages, and the list of them, into a new folder."""
    pages.mkdir(parents=True)
    for path in ["README.md", *(path for paths in PAGES.values() for path in paths if path not in MADE)]:
        text = linked((REPOSITORY / path).read_text(encoding="utf-8"), path, pages)
        (pages / page_of(path)).write_text(text, encoding="utf-8")
    for name, text_of in MADE.items():
        (pages / f"{name}.md").write_text(text_of(), encoding="utf-8")
    with open(pages / "index.md", "a", encoding="utf-8") as index:
        for caption, paths in PAGES.items():
            names = "\n".join(page_of(path).removesuffix(".md") for path in paths)
            index.write(f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{names}\n```\n")


def main(site: Path) -> int:
    """Make the site; return Sphinx's exit status."""
    pages = site.with_name(f"{site.name}.pages")
    for folder in (site, pages):
        shutil.rmtree(folder, ignore_errors=True)
    gather(pages)
    sphinx = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet", "-b", "html"]
    return subprocess.run([*sphinx, "-c", str(Path(__file__).parent), str(pages), str(site)], check=False).returncode


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
