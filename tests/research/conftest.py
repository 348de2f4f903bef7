from collections.abc import Iterator

import pytest

from tests.research.tiny_baseline import registered


@pytest.fixture(autouse=True)
def baselines() -> Iterator[None]:
    """The engine knows the baselines in each of these tests, and in no other."""
    with registered():
        yield
