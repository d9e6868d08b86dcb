"""Modbus RTU."""

from __future__ import annotations

from busmaster.contract.items import Item
from busmaster.protocols.modbus.capture import ModbusDialect
from busmaster.protocols.modbus.codec import (
    PROFILE,
    MergedRead,
    ReadBits,
    ReadRegisters,
    WriteCoils,
    WriteRegisters,
)
from busmaster.protocols.modbus.handle import ModbusUnit, is_whole, width_of
from busmaster.registry import NodeKind, Option, Protocol, device_of

PROTOCOL = Protocol(
    profile=PROFILE,
    kinds=(
        NodeKind(
            "modbus",
            ModbusUnit,
            device_of("busmaster.protocols.modbus.device"),
            items="holding:100, input:100, coil:5, discrete:5 (addresses as sent, 0 to 65535); holding:100:10 (ten "
            "from there on). holding:100:float32 (int16 uint16 int32 uint32 int64 uint64 float32 float64; most "
            "significant word first; last with :swapped)",
            probe_item="holding:0",
            documented=(
                Item("coil:0-65535", "0-65535", "a bit, read by function 1, written by 5 and 15", access="read/write"),
                Item("discrete:0-65535", "0-65535", "an input bit, read by function 2", access="read"),
                Item(
                    "holding:0-65535",
                    "0-65535",
                    "a register of 16 bits, read by function 3, written by 6 and 16",
                    access="read/write",
                ),
                Item("input:0-65535", "0-65535", "an input register of 16 bits, read by function 4", access="read"),
            ),
            options=(
                Option(
                    "registers_per_read",
                    "whole",
                    about="How many registers the unit returns in one reply, 1 to 125; 125 by default. Neighbouring "
                    "registers of a poll group are read in one exchange up to this number.",
                ),
                Option(
                    "bits_per_read",
                    "whole",
                    about="How many coils or discrete inputs the unit returns in one reply, 1 to 2000; 2000 by "
                    "default.",
                ),
            ),
            whole_numbers=is_whole,
            width=width_of,
            emulated=(
                Option("size", "whole", about="Number of addresses of each of its four tables; 1000 by default."),
                Option(
                    "functions",
                    "numbers",
                    about="The function codes that it supports; by default all that busmaster sends. Others are "
                    "refused with exception 1.",
                ),
                Option("read_only", "numbers", about="The holding registers that refuse writes, with exception 3."),
            ),
            capture_id=7,
        ),
    ),
    commands={
        "read_bits": ReadBits,
        "read_merged": MergedRead,
        "read_registers": ReadRegisters,
        "write_coils": WriteCoils,
        "write_registers": WriteRegisters,
    },
    dialect=ModbusDialect,
)
