"""Restores the constants that learned hunts set."""

from __future__ import annotations

import pytest

from busmaster.arbiter import learned


@pytest.fixture(autouse=True)
def constants_of_learning(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("TRUSTED_AFTER", "TRUSTED_AGAIN_AFTER", "EPOCH"):
        monkeypatch.setattr(learned, name, getattr(learned, name))
