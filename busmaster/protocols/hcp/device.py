"""An emulated Mint controller with HCP."""

from __future__ import annotations

from functools import partial

from busmaster.protocols._comms.device import HCP
from busmaster.protocols._comms.mint import make_mint

make_device = partial(make_mint, HCP)
