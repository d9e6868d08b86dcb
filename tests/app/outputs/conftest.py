"""What the tests of outputs share: a real broker, and commands that do not grow old while a busy machine turns."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from busmaster.app.service import authorisation
from tests.app.outputs.brokers import Broker, running
from tests.patience import PATIENCE


@pytest.fixture(autouse=True)
def commands_stay_fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(authorisation, "FRESH", PATIENCE)


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    with running(tmp_path) as found:
        yield found
