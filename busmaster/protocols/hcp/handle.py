"""The handle of a controller with HCP."""

from __future__ import annotations

from typing import ClassVar

from busmaster.contract.profile import Profile
from busmaster.protocols._comms.handle import MintHandle
from busmaster.protocols.hcp import codec as hcp


class HcpController(MintHandle):
    """A Mint controller over HCP: nodes 0-15, comms elements 1-99.

        winder = HcpController(bus, 2)
        await winder.write(1, 100.0, 250.0)      # Comms(1) and Comms(2), in one telegram
        position = await winder.read(4)

    `read` and `write` access comms elements by their number.
    """

    profile: ClassVar[Profile] = hcp.PROFILE
    _read_command = hcp.Read
    _write_command = hcp.Write
    _form = "an element number, 1 to 99"
