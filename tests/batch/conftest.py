from collections.abc import Iterator

import pytest

from engine.batch import cluster
from tests.batch.farm import Farm
from tests.waiting import PATIENCE_S


@pytest.fixture
def farm(monkeypatch: pytest.MonkeyPatch) -> Iterator[Farm]:
    """Empty. A busy machine needs more than five seconds to start a worker."""
    monkeypatch.setattr(cluster, "NO_WORKER_S", PATIENCE_S)
    farm = Farm()
    yield farm
    farm.close()


@pytest.fixture
def address(farm: Farm) -> str:
    """Of a scheduler without workers."""
    return f"tcp://127.0.0.1:{farm.scheduler()[1]}"
