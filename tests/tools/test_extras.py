"""A missing package of an extra: the error names package, extra and the folder that `make` is called in."""

from pathlib import Path

import pytest
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.extras import needed

from tests.processes import REPOSITORY


@pytest.mark.parametrize("elsewhere", [True, False])
def test_an_error_names_the_folder_that_make_is_called_in(
    elsewhere: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path if elsewhere else REPOSITORY)
    with pytest.raises(BuddylineError) as refused:
        needed("no_such_package", "drawing", "plots")
    call = f"make install EXTRAS=plots in {REPOSITORY}" if elsewhere else "make install EXTRAS=plots"
    assert str(refused.value).endswith(f"(no_such_package): {call}")
