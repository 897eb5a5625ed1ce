"""`buddyline doctor`: check everything before a dive; a line each: OK, warning or problem, and what to do about it."""

from __future__ import annotations

import argparse
import json
from typing import Final

from buddyline.tools.health.finding import Finding, Level, status_of
from msgspec.structs import replace

MARKS: Final[dict[Level, str]] = {"ok": "OK", "warning": "warning", "problem": "PROBLEM", "skipped": "-"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.description = (
        f"{parser.description} Exit status: 0 no problem (there may be warnings), 1 a problem was found, "
        "2 the configuration cannot be used."
    )
    parser.add_argument(
        "--config",
        metavar="FILE.toml",
        help="a node's configuration: its devices are checked too; or a client's: its hub",
    )
    parser.add_argument("--connect", metavar="ENDPOINT", help="the hub, as tcp/host:7447; replaces the configured one")
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")


def run(args: argparse.Namespace) -> int:
    """Check everything within ten seconds; return 1 if there is a problem."""
    from buddyline.tools.doctor.diagnosis import diagnose, load

    node, client = load(args.config)
    if args.connect:
        client = replace(client, connect=args.connect)
    findings = diagnose(node, client)
    if args.json:
        listed = [{name: getattr(one, name) for name in ("name", "level", "text", "advice")} for one in findings]
        print(json.dumps({"status": status_of(findings), "findings": listed}))
    else:
        print("\n".join(line for finding in findings for line in lines_of(finding)))
    return status_of(findings)


def lines_of(finding: Finding) -> list[str]:
    """Return the printed lines of a finding."""
    lines = [f"{MARKS[finding.level]:<8} {finding.name:<12} {finding.text}"]
    return lines + ([f"{'':<21} -> {finding.advice}"] if finding.advice else [])
