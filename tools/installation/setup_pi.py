"""`buddyline setup pi`: what node/README.md asks for on Raspberry Pi OS, step by step; without --apply it only says it.

A step that is done is left alone, so the command can be called again: when nothing is left to do, it runs `doctor`.
What it writes takes effect when the Pi starts again.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import platform
import pwd
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from buddyline.protocol.errors import BuddylineError
from buddyline.tools.installation import install_service, pi

if TYPE_CHECKING:
    from buddyline.node.config import NodeConfig

# What each extra gives, and, of the system's packages, the camera.
MODULES: Final = {"pi": ("picamera2", "gpiozero", "smbus2", "vqf", "pygeomag"), "keys": ("cryptography",)}
UNIT: Final = "buddyline-node.service"
TETHER_FILE: Final = "/etc/NetworkManager/system-connections/buddyline.nmconnection"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("machine", choices=("pi",), help="a Raspberry Pi with Raspberry Pi OS (64 bit)")
    pi.add_arguments(parser)
    parser.add_argument(
        "--address",
        metavar="IP/BITS",
        help="the node's, on the tether; default: 192.168.2.2/24 for a, .3 for b; keep: leave the network as it is",
    )
    parser.add_argument("--run-as", metavar="USER", help="who runs the node; default: who called sudo")
    parser.add_argument("--apply", action="store_true", help="do it; needs root. Default: only say what is to do")


@dataclass(frozen=True)
class SetupStep:
    """One thing to do: its name, what doing it means, whether it is done, and how it is done."""

    name: str
    means: str
    done: bool
    do: Callable[[], None]


def run(args: argparse.Namespace) -> int:
    """Say each step, with --apply do those that are left; with none left, return doctor's status."""
    user = install_service.runner(args.run_as)
    try:
        pwd.getpwnam(user)
    except KeyError as error:
        raise BuddylineError(f"--run-as {user}: there is no such user here") from error
    if args.apply and os.geteuid() != 0:
        raise BuddylineError("--apply changes the system: call it with sudo")
    left = 0
    for step in steps(args, user, Path("/")):
        print(f"{'done' if step.done else 'to do':<6} {step.name:<12} {step.means}", flush=True)
        if step.done:
            continue
        left += 1
        if args.apply:
            step.do()
    if left and args.apply:
        print(f"{left} done; restart the Pi (sudo reboot), then call this again without --apply: it runs doctor")
    elif left:
        print(f"{left} to do; nothing was changed: --apply (with sudo) does it")
    else:
        print("nothing is left to do; doctor says:", flush=True)
        return subprocess.run([*_program(), "doctor", "--config", args.config], check=False, **_as(user)).returncode
    return 0


def steps(args: argparse.Namespace, user: str, root: Path) -> Iterator[SetupStep]:
    """Yield the steps in order. root: where the system is, other than / in tests."""
    config = pi.load(args.config)
    boot = root / "boot" / "firmware" / "config.txt"
    if not boot.exists():
        raise BuddylineError(f"{boot}: not there: `setup pi` is for Raspberry Pi OS, from Bookworm on")
    yield _packages()
    yield _environment(user, pi.extras(config))
    yield _file("devices", boot, pi.with_block(pi.read_text(boot), pi.config_lines(config, args.clock_chip)))
    for name, text in pi.system_files(config, user, args.clock_from).items():
        yield _file("file", root / name[1:], text)
    if args.address != "keep":
        tether = pi.TETHER.format(address=pi.address_of(config, args.address))
        # NetworkManager takes no file that others may read.
        yield _file("address", root / TETHER_FILE[1:], tether, 0o600)
    # A relative one is below the service's working directory.
    yield _folder(root / str(install_service.STATE / config.record.directory)[1:], user)
    yield from _service(args, user, root, config)


def _packages() -> SetupStep:
    said = _output("dpkg-query", "--show", "--showformat", r"${Package} ${db:Status-Status}\n", *pi.PACKAGES)
    there = {line.split()[0] for line in said.splitlines() if line.endswith(" installed")}
    missing = [name for name in pi.PACKAGES if name not in there]

    def do() -> None:
        _call(["apt-get", "update"])
        _call(["apt-get", "install", "-y", *missing], DEBIAN_FRONTEND="noninteractive")

    return SetupStep("packages", f"apt-get install {' '.join(missing or pi.PACKAGES)}", not missing, do)


def _environment(user: str, extras: str) -> SetupStep:
    """Have these extras and the system's camera in this environment."""
    wanted = [name for extra in extras.split(",") for name in MODULES[extra]]
    done = all(importlib.util.find_spec(name) is not None for name in wanted)
    copy = Path(sys.prefix).parent
    words = ["make", "-C", str(copy), "install", f"EXTRAS={extras}"]
    if _codename() == "bookworm":
        words.append("CONSTRAINTS=node/examples/bookworm.txt")

    def do() -> None:
        if not (copy / "Makefile").exists():
            raise BuddylineError(
                f"{sys.prefix}: is not the .venv of a copy of the repository: install the extras {extras} there by hand"
            )
        _call(words, user=user)

    return SetupStep("environment", " ".join(words), done, do)


def _file(name: str, path: Path, text: str, mode: int = 0o644) -> SetupStep:
    try:
        before = path.read_text() if path.exists() else ""
    except PermissionError:
        return SetupStep(name, f"{path} is there; only root can read it", True, lambda: None)
    was, wanted = before.splitlines(), text.splitlines()
    changes = [f"- {line}" for line in was if line not in wanted] + [f"+ {line}" for line in wanted if line not in was]
    means = "\n".join([str(path), *(f"{'':<20}{line}" for line in changes)])
    return SetupStep(name, means, before == text, lambda: pi.replace_file(path, text, mode))


def _folder(path: Path, user: str) -> SetupStep:
    def do() -> None:
        path.mkdir(parents=True, exist_ok=True)
        shutil.chown(path, user)

    done = path.is_dir() and path.stat().st_uid == pwd.getpwnam(user).pw_uid
    return SetupStep("folder", f"{path}, of {user}", done, do)


def _service(args: argparse.Namespace, user: str, root: Path, config: NodeConfig) -> Iterator[SetupStep]:
    source = install_service.source_of(argparse.Namespace(service="node", config=args.config, run_as=user, user=False))
    units = root / "etc" / "systemd" / "system"
    yield _file("service", units / UNIT, install_service.system_unit(source))
    yield SetupStep(
        "start",
        f"systemctl enable {UNIT}: node {config.node} starts with the Pi",
        (units / "multi-user.target.wants" / UNIT).is_symlink(),
        lambda: _call(["systemctl", "enable", UNIT]),
    )


def _program() -> list[str]:
    return [sys.executable, "-P", "-m", "buddyline"]


def _codename() -> str:
    try:
        return platform.freedesktop_os_release().get("VERSION_CODENAME", "")
    except OSError:
        return ""


def _as(user: str) -> dict[str, Any]:
    """Return how subprocess runs something for a user: as that user, where we are root."""
    if os.geteuid() != 0:
        return {}
    account = pwd.getpwnam(user)
    groups = os.getgrouplist(user, account.pw_gid)
    own = {"HOME": account.pw_dir, "USER": user, "LOGNAME": user}
    return {"user": user, "group": account.pw_gid, "extra_groups": groups, "env": {**os.environ, **own}}


def _output(*words: str) -> str:
    """Return what a program says of the system, whatever its status."""
    try:
        return subprocess.run(words, capture_output=True, text=True, check=False).stdout
    except FileNotFoundError as error:
        raise BuddylineError(f"{words[0]}: not there: `setup pi` is for Raspberry Pi OS") from error


def _call(words: Sequence[str], user: str = "root", **own: str) -> None:
    """Run one step's program; raise BuddylineError where it fails, and name it. own: further environment."""
    options = _as(user)
    options["env"] = {**options.get("env", os.environ), **own}
    try:
        status = subprocess.run(words, check=False, **options).returncode
    except FileNotFoundError as error:
        raise BuddylineError(f"{words[0]}: not there") from error
    if status != 0:
        raise BuddylineError(f"`{' '.join(words)}` ended with {status}, see above; call again when that is mended")
