"""Options of the tests, and hypothesis without a deadline: a loaded machine may need long for an example."""

import os

from hypothesis import settings

# Set before numpy is imported: on a loaded machine OpenBLAS's threads wait for each other, and the matrices are small.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

settings.register_profile("buddyline", deadline=None)
settings.load_profile("buddyline")


def pytest_addoption(parser):
    parser.addoption(
        "--update-refs", action="store_true", help="rewrite the golden results (tests/golden) that have changed"
    )
