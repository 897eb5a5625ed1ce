"""Options of the tests, and hypothesis without a deadline: a loaded machine may need long for an example."""

from hypothesis import settings

settings.register_profile("buddyline", deadline=None)
settings.load_profile("buddyline")


def pytest_addoption(parser):
    parser.addoption(
        "--update-refs", action="store_true", help="rewrite the golden results (tests/golden) that have changed"
    )
