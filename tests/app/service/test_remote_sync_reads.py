"""Which probe and sync reads a node has that another program names first."""

from __future__ import annotations

from typing import Any

import pytest

from busmaster.app.service.encoding import SyncReads, encode_sync_reads, profile_of
from busmaster.app.service.fields import protocol_of
from busmaster.errors import InvalidCommand
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2 import microflex

HCP2 = protocol_of("hcp2")
READ, WRITE = {"command": "read", "element": 1}, {"command": "write", "element": 1, "values": [1.0]}


def test_only_what_is_not_the_protocols_is_sent() -> None:
    assert encode_sync_reads(hcp2.PROFILE) == SyncReads(None, None)
    form = encode_sync_reads(microflex.PROFILE)
    assert form.probe == {"command": "read", "element": 109}
    found = profile_of(HCP2, form)
    assert (found.probe, found.sync_reads) == (microflex.PROFILE.probe, microflex.PROFILE.sync_reads)
    assert profile_of(HCP2, SyncReads()) is hcp2.PROFILE


@pytest.mark.parametrize(
    ("probe", "sync_reads"),
    [
        (WRITE, [READ]),
        (READ, [READ, WRITE]),
        (READ, None),
        (None, [READ]),
    ],
)
def test_what_is_no_read_is_refused(probe: Any, sync_reads: Any) -> None:
    with pytest.raises(InvalidCommand):
        profile_of(HCP2, SyncReads(probe, sync_reads))
