"""Keys for tests: an authority with every identity, made once, and invalid identities."""

from __future__ import annotations

import shutil
from pathlib import Path

from buddyline.protocol.security import Tls
from buddyline.tools.authority import Authority
from buddyline.tools.cli import main


def make_keys(directory: Path, *nodes: str) -> Path:
    """Make an authority and everyone's certificates, as a person does."""
    roles = (["solver"], ["viewer"], ["surveyor"], ["player"], ["ros2"])
    for words in (["init"], *(["node", node] for node in nodes), *roles):
        assert main(["keys", "--directory", str(directory), *words]) == 0
    return directory


def expired(keys: Path, name: str, host: str | None = None) -> None:
    """Put an expired certificate in the place of a sound one."""
    for ending in ("crt", "key"):
        (keys / f"{name}.{ending}").unlink()
    Authority.open(keys).issue(name, -1, server_host=host)


def tls(keys: Path, name: str) -> Tls:
    return Tls(ca=str(keys / "ca.crt"), certificate=str(keys / f"{name}.crt"), key=str(keys / f"{name}.key"))


def copy_of(keys: Path, to: Path) -> Path:
    shutil.copytree(keys, to)
    return to
