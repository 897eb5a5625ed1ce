"""At the tab key, bash offers the commands, options and values that the program has."""

import shutil
import subprocess

import pytest
from buddyline.tools.cli import COMMANDS, main

TRIED = """
. ./script
COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
_shtab_buddyline
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.fixture(scope="module")
def offered(tmp_path_factory):
    """Ask bash what it offers after some words."""
    pytest.importorskip("shtab", reason="the extra completion is not installed")
    if shutil.which("bash") is None:
        pytest.skip("bash is not installed")
    folder = tmp_path_factory.mktemp("completion")
    (folder / "dive.mcap").touch()

    def ask(words):
        done = subprocess.run(
            ["bash", "-c", TRIED.format(words=words)],
            capture_output=True, text=True, timeout=60, check=False, cwd=folder,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return set(done.stdout.split())

    return folder, ask


def test_commands_options_values_and_files_are_offered(offered, capsys):
    folder, ask = offered
    assert main(["completion", "bash"]) == 0
    (folder / "script").write_text(capsys.readouterr().out)
    assert {command.name for command in COMMANDS} <= ask("buddyline ''")
    assert ask("buddyline solve --me") == {"--method"}
    assert "refined" in ask("buddyline solve --method ''")
    assert ask("buddyline solve di") == {"dive.mcap"}
    assert ask("buddyline calibrate cam") == {"camera"}
    for shell in ("zsh", "tcsh"):
        assert main(["completion", shell]) == 0
        assert "calibrate" in capsys.readouterr().out
