"""The core does what it did when the digests of its transcripts were kept."""

from __future__ import annotations

import pytest

from busmaster.arbiter.unexpected import QUIET
from tests.verification.campaigns.digests import changed, digest, kept, names

SAMPLE = 53
"""Every so many-th hunt is run here, prime to how many each protocol and mix has; all by the command of the module."""


def test_each_hunt_has_a_digest_and_each_digest_a_hunt() -> None:
    assert sorted(kept()) == sorted(names())


@pytest.mark.slow
def test_a_sample_of_the_transcripts_is_what_it_was() -> None:
    sample = list(names())[::SAMPLE]
    others = changed(((name, digest(name)) for name in sample), kept())
    assert not others, "python -m tests.verification.campaigns.digests lists all; a change of behaviour writes new ones"


def test_another_silence_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "hcp2/lost/1/documents"
    monkeypatch.setattr("busmaster.arbiter.on_wire.QUIET", QUIET + 0.001)
    assert changed([(name, digest(name))], kept()) == [name]
