"""The default suite on each Python, and with the lowest and the newest packages that pyproject.toml allows.

    make matrix                                                       # all of it: five times the default suite
    .venv/bin/python -m tests.matrix --only 3.11-lowest tests/node    # one of them, some of the tests

`pinned` has the versions of constraints.txt, `lowest` the lowest of each package that pyproject.toml names, `newest`
the newest of all. The lowest are older than the newest Pythons, so they are tried on the oldest alone. Tests need a
newer OpenCV, and with it numpy, than the program does: `least` has the lowest that the program takes, and solves the
sample. Each environment is made in build/matrix and kept. A Python is taken from the path or from pyenv; one that is
missing is named, and is no failure.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.processes import REPOSITORY
from tests.wheels import PYTHONS, interpreter

FOLDER = REPOSITORY / "build" / "matrix"
LOWEST = ("--resolution", "lowest-direct", "--editable")
HOW = {
    "pinned": ("-c", "constraints.txt", "--editable", ".[dev]"),
    "lowest": (*LOWEST, ".[dev]"),
    "least": (*LOWEST, "."),
    "newest": ("--upgrade", "--editable", ".[dev]"),
}
OLDEST, NEWEST = PYTHONS[0], PYTHONS[-1]
ENTRIES = (*(f"{python}-pinned" for python in PYTHONS), f"{OLDEST}-lowest", f"{OLDEST}-least", f"{NEWEST}-newest")


def call(*words: str | Path) -> None:
    """Run a program in the repository; raise CalledProcessError where it fails."""
    # uv then trusts what this machine trusts, as pip does.
    subprocess.run(words, check=True, cwd=REPOSITORY, env={**os.environ, "UV_NATIVE_TLS": "1"})


def installer() -> Path:
    """Return uv, which alone can choose the lowest versions; pip installs it."""
    uv = FOLDER / "uv" / "bin" / "uv"
    if not uv.exists():
        call(sys.executable, "-m", "venv", FOLDER / "uv")
        call(FOLDER / "uv" / "bin" / "pip", "install", "--quiet", "--disable-pip-version-check", "uv")
    return uv


def environment(entry: str, python: Path) -> Path:
    """Make an environment, or bring it up to date; return its Python."""
    uv, made = installer(), FOLDER / entry / "bin" / "python"
    if not made.exists():
        call(uv, "venv", "--quiet", "--python", python, FOLDER / entry)
    how = HOW[entry.partition("-")[2]]
    call(uv, "pip", "install", "--quiet", "--python", made, *how)
    return made


def solve_sample(python: Path) -> None:
    """Let the program solve the sample, and run the demo."""
    with tempfile.TemporaryDirectory() as folder:
        sample, solved = f"{folder}/sample.mcap", f"{folder}/solved.mcap"
        for words in (("sample", "-o", sample), ("solve", sample, "-o", solved), ("demo", "--seconds", "8")):
            call(python, "-m", "buddyline", *words)


def main() -> int:
    """Run the tests in each environment; say how each went; 1 where one failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.matrix", description=__doc__.split("\n")[0])
    parser.add_argument("--only", action="append", choices=ENTRIES, help="repeatable; default: all")
    args, words = parser.parse_known_args()
    results = {}
    for entry in args.only or ENTRIES:
        python = interpreter(entry.partition("-")[0])
        if python is None:
            results[entry] = "no such Python here"
            continue
        print(f"== {entry}", flush=True)
        try:
            made = environment(entry, python)
            if entry.endswith("least"):
                solve_sample(made)
                results[entry] = "passed"
                continue
            # An old package may call what a newer one has deprecated, as matplotlib 3.8 does of pyparsing 3.3.
            calm = ("-W", "ignore::DeprecationWarning") if entry.endswith("lowest") else ()
            call(made, *calm, "-m", "pytest", *calm, *words)
            results[entry] = "passed"
        except subprocess.CalledProcessError as error:
            results[entry] = f"FAILED: {Path(error.cmd[0]).name} {error.cmd[-1]}"
    print("\n".join(f"{entry:<12} {result}" for entry, result in results.items()))
    return 1 if any(result.startswith("FAILED") for result in results.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
