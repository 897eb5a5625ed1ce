"""`buddyline install-service`: writes systemd units for node, hub and solver; replaces none without --force."""

from __future__ import annotations

import argparse
import difflib
import getpass
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from buddyline.protocol.errors import BuddylineError

STATE: Final = Path("/var/lib/buddyline")
# After chrony, if it is installed: the triggers are instants of the clock that it sets.
AFTER: Final = {
    "node": "chrony.service",
    "hub": "network-online.target",
    "solver": "buddyline-hub.service",
}
# Keeps a service away from what it does not need of the system: `systemd-analyze security` says 2.5 or less.
HARDENING: Final = """
NoNewPrivileges=yes
CapabilityBoundingSet=
ProtectSystem=strict
ProtectHome=read-only
PrivateTmp=yes
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectKernelLogs=yes
ProtectControlGroups=yes
ProtectHostname=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
RestrictNamespaces=yes
RestrictSUIDSGID=yes
RestrictRealtime=yes
LockPersonality=yes
RemoveIPC=yes
ProtectProc=invisible
UMask=0027
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@privileged @resources
SystemCallErrorNumber=EPERM
""".strip()
# PrivateUsers would take away the groups that may open camera and I2C bus.
WITHOUT_DEVICES: Final = "PrivateDevices=yes\nProtectClock=yes\nPrivateUsers=yes"
# Device classes of /proc/devices: cameras with their controllers and buffers (libcamera), I2C, GPIO, PPS.
WITH_DEVICES: Final = "\n".join(
    [
        "DevicePolicy=closed",
        *(f"DeviceAllow=char-{name} rw" for name in ("video4linux", "media", "dma_heap", "i2c", "gpiochip", "pps")),
        "DeviceAllow=/dev/udmabuf rw",
        "DeviceAllow=/dev/vcio rw",
    ]
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("service", choices=tuple(AFTER), help="which unit to write: buddyline-<service>.service")
    parser.add_argument("--config", metavar="FILE.toml", help="its configuration; a node must have one")
    parser.add_argument(
        "--run-as",
        metavar="USER",
        help="who runs the service; default: who called sudo. The unit adds the groups that it needs",
    )
    parser.add_argument("--print", action="store_true", help="show the unit, write nothing")
    parser.add_argument("--user", action="store_true", help="write a unit of your own (systemctl --user), not hardened")
    parser.add_argument("--root", metavar="DIR", help="write below this directory, such as a mounted card")
    parser.add_argument("--force", action="store_true", help="replace a unit that has other contents")


@dataclass(frozen=True)
class UnitSource:
    """The input of a unit. groups: of the devices it opens; writable: directories it writes besides its state."""

    service: str
    config: Path | None = None
    user: str = ""
    groups: tuple[str, ...] = ()
    writable: tuple[Path, ...] = ()


def run(args: argparse.Namespace) -> int:
    """Write one unit, or show it."""
    if args.user and (args.root or args.run_as):
        raise BuddylineError("--user writes a unit of your own: it goes with neither --root nor --run-as")
    source = source_of(args)
    text = user_unit(source) if args.user else system_unit(source)
    if args.print:
        sys.stdout.write(text)
        return 0
    unit = f"buddyline-{source.service}"
    path = _directory(args) / f"{unit}.service"
    print(f"{path}: {_write(path, text, force=args.force)}")
    if not args.root:
        print(_next_commands(unit, user=args.user))
    return 0


def system_unit(source: UnitSource) -> str:
    """Return the unit of the whole machine."""
    lines = [
        "StateDirectory=buddyline",
        f"WorkingDirectory={STATE}",
        f"User={source.user}",
        *([f"SupplementaryGroups={' '.join(source.groups)}"] if source.groups else []),
        *(f"ReadWritePaths={_quoted(f'-{path}')}" for path in source.writable),
        HARDENING,
        WITH_DEVICES if source.groups else WITHOUT_DEVICES,
    ]
    return _unit(source, lines, "multi-user.target")


def user_unit(source: UnitSource) -> str:
    """Return the unit for a user's own service manager, which has no right to harden a service."""
    directory = source.config.parent if source.config else Path.home()
    return _unit(source, [f"WorkingDirectory={str(directory).replace('%', '%%')}"], "default.target")


def _unit(source: UnitSource, lines: list[str], target: str) -> str:
    words = [str(_program()), source.service, *(["--config", str(source.config)] if source.config else [])]
    after = AFTER[source.service]
    own = "\n".join(lines)
    return f"""\
# Written by `buddyline install-service`; your own changes: `systemctl edit buddyline-{source.service}`.
[Unit]
Description=Buddyline {source.service}
After={after}
{f"Wants={after}" if source.service == "hub" else ""}
# Restart without a limit: under water nobody is there to start it.
StartLimitIntervalSec=0

[Service]
Type=notify
ExecStart={" ".join(_quoted(word) for word in words)}
TimeoutStartSec=60
WatchdogSec=10
Restart=on-failure
RestartSec=2
TimeoutStopSec=10
RuntimeDirectory=buddyline
# The three services share it: the first that ends must not remove it.
RuntimeDirectoryPreserve=yes
{own}

[Install]
WantedBy={target}
"""


def source_of(args: argparse.Namespace) -> UnitSource:
    """Check the service's configuration; return what the unit needs of it."""
    config = Path(args.config).resolve() if args.config else None
    user = runner(args.run_as, own=args.user)
    if args.service == "node":
        if config is None:
            raise BuddylineError("a node needs its configuration: --config FILE.toml")
        from buddyline.node.config import load_node_config

        node = load_node_config(config)
        groups = ["video"] if node.camera.name == "picamera2" else []
        groups += ["i2c"] if node.uses_i2c else []
        groups += ["gpio"] if node.panel.pins else []
        directory = Path(node.record.directory)
        writable = (directory,) if directory.is_absolute() and not directory.is_relative_to(STATE) else ()
        return UnitSource("node", config, user, tuple(groups), writable)
    if config is not None and args.service == "hub":
        from buddyline.tools.hub import load_hub_config

        load_hub_config(str(config))
    elif config is not None:
        from buddyline.solver_service.config import load_solver_config

        load_solver_config(config)
    return UnitSource(args.service, config, user)


def runner(run_as: str | None, *, own: bool = False) -> str:
    """Return the user who runs a service: as named, else who called sudo. own: a user's own unit, even root's."""
    user: str = run_as or os.environ.get("SUDO_USER") or getpass.getuser()
    if user == "root" and not run_as and not own:
        raise BuddylineError("--run-as USER: name the user who runs it; without one it would be root")
    if not all(letter.isalnum() or letter in "_-." for letter in user):
        raise BuddylineError(f"--run-as {user}: not a user's name")
    return user


def _program() -> Path:
    """Return the path of the installed program; raise BuddylineError if it is not installed."""
    program = Path(sys.executable).parent / "buddyline"
    if not program.is_file():
        raise BuddylineError(f"{program}: not there; install the program first: make install")
    return program


def _directory(args: argparse.Namespace) -> Path:
    if args.user:
        return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "systemd" / "user"
    return Path(args.root or "/") / "etc" / "systemd" / "system"


def _write(path: Path, text: str, *, force: bool) -> str:
    """Write a unit; return what was done. A different existing one is shown, and replaced only with force."""
    try:
        before = path.read_text() if path.exists() else None
        if before == text:
            return "is as it should be"
        if before is not None:
            difference = difflib.unified_diff(
                before.splitlines(keepends=True), text.splitlines(keepends=True), f"{path} as it is", "as it would be"
            )
            sys.stderr.writelines(difference)
            if not force:
                raise BuddylineError(f"{path}: has other contents, see above; --force replaces it")
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = path.with_name(f".{path.name}.new")
        fresh.write_text(text)
        fresh.replace(path)
    except PermissionError as error:
        raise BuddylineError(f"{path}: not allowed: use sudo, or --user") from error
    except OSError as error:
        raise BuddylineError(f"{path}: cannot be written: {error.strerror}") from error
    return "written" if before is None else "replaced"


def _next_commands(unit: str, *, user: bool) -> str:
    own = " --user" if user else ""
    systemctl = "systemctl --user" if user else "sudo systemctl"
    linger = "\n  loginctl enable-linger             # without you being logged in" if user else ""
    return f"""\
next:
  {systemctl} daemon-reload
  {systemctl} enable {unit}          # from the next start of the machine on
  {systemctl} restart {unit}         # and now
  systemctl{own} status {unit}
  journalctl{own} -fu {unit}{linger}"""


def _quoted(text: str) -> str:
    """Return a word quoted for a unit's ExecStart."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return f'"{escaped}"' if any(letter in escaped for letter in " \t\"'\\;") else escaped
