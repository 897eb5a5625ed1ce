"""Options of the tests, and hypothesis without a deadline: on a loaded machine an example takes as long as it takes."""

from hypothesis import settings

settings.register_profile("buddyline", deadline=None)
settings.load_profile("buddyline")


def pytest_addoption(parser):
    parser.addoption(
        "--update-refs", action="store_true", help="rewrite the golden results (tests/golden) that have changed"
    )
