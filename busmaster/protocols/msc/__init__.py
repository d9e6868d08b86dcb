"""MSC controllers (IB-11A002 rev E)."""

from __future__ import annotations

from busmaster.protocols.msc import codec
from busmaster.protocols.msc.capture import MscDialect
from busmaster.protocols.msc.codec import PROFILE
from busmaster.protocols.msc.handle import MscController
from busmaster.protocols.msc.items import ITEMS, width_of
from busmaster.protocols.msc.listing import read_listing
from busmaster.protocols.msc.status import ProgramStatus
from busmaster.registry import NodeKind, Option, Protocol, device_of, everywhere

ADDRESS_STEP = Option(
    "address_step",
    "whole",
    "addresses from one value to the next",
    about="Difference of the data addresses of two consecutive values: 1, 2 or 4. Its emulated unit has 4 by default.",
)
MODEL = Option(
    "model",
    "text",
    choices=("MSC-250", "MSC-850", "MSC-850/32"),
    about="The model, which determines the supported commands. For its emulated unit MSC-250 by default.",
)

__all__ = ["PROTOCOL", "ProgramStatus"]

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
                Option(
                    "symbols",
                    "addresses",
                    common=False,
                    reader=read_listing,
                    about="Names of data addresses, `{ count = 2008 }`; or the path of the program's listing, from "
                    "the folder of LINE.toml.",
                ),
                ADDRESS_STEP,
                MODEL,
            ),
            emulated=(
                ADDRESS_STEP,
                MODEL,
                Option("addresses", "whole", about="Number of data addresses; 32768 by default."),
                Option(
                    "read_only_flags",
                    "numbers",
                    about="The flags that cannot be set or cleared, such as inputs and timers.",
                ),
                Option("battery", "flag", about="Data survives a power failure, and the program starts again."),
                Option(
                    "period",
                    "positive",
                    about="Period in seconds with which its program adds 1 to the value at 2000; 0.1 by default.",
                ),
                Option(
                    "packet_delay",
                    "delay",
                    about="Time from the end of an ACK to the packet after it; 0.002 by default.",
                ),
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
