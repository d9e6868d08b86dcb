"""MSC controllers (IB-11A002 rev E)."""

from __future__ import annotations

from busmaster.protocols.msc import codec
from busmaster.protocols.msc.capture import MscDialect
from busmaster.protocols.msc.codec import PROFILE
from busmaster.protocols.msc.handle import MscController
from busmaster.protocols.msc.items import ITEMS, width_of
from busmaster.protocols.msc.listing import read_listing
from busmaster.registry import NodeKind, Option, Protocol, device_of, everywhere

ADDRESS_STEP = Option("address_step", "whole", "addresses from one value to the next")
MODEL = Option("model", "text", choices=("MSC-250", "MSC-850", "MSC-850/32"))

PROTOCOL = Protocol(
    profile=PROFILE,
    kinds=(
        NodeKind(
            "msc",
            MscController,
            device_of("busmaster.protocols.msc.device"),
            items="2008 (a data address), 2008:32 (32 values from there on), flag:5, flags, status",
            probe_item="status",
            documented=ITEMS,
            options=(
                Option("symbols", "addresses", common=False, reader=read_listing),
                ADDRESS_STEP,
                MODEL,
            ),
            emulated=(
                ADDRESS_STEP,
                MODEL,
                Option("addresses", "whole"),
                Option("read_only_flags", "numbers"),
                Option("battery", "flag"),
                Option("period", "positive"),
                Option("packet_delay", "delay"),
            ),
            whole_numbers=everywhere,
            width=width_of,
            capture_id=4,
        ),
    ),
    commands={
        "read_data": codec.DataRead,
        "write_data": codec.DataWrite,
        "read_block": codec.BlockRead,
        "write_block": codec.BlockWrite,
        "pick_data": codec.PickedData,
        "read_flag": codec.ReadFlag,
        "set_flag": codec.SetFlag,
        "clear_flag": codec.ClearFlag,
        "read_flags": codec.ReadFlags,
        "pick_flags": codec.PickedFlags,
        "read_status": codec.ReadStatus,
    },
    dialect=MscDialect,
)
