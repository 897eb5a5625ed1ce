def pytest_addoption(parser):
    parser.addoption(
        "--update-refs", action="store_true", help="rewrite the golden results (tests/golden) that have changed"
    )
