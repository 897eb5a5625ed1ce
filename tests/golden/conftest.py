import pytest


@pytest.fixture(scope="session")
def update_refs(request):
    """Whether the golden results are to be rewritten."""
    return request.config.getoption("--update-refs", default=False)


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("golden")
