"""Modbus RTU."""

from __future__ import annotations

from busmaster.protocols.modbus.capture import ModbusDialect
from busmaster.protocols.modbus.codec import PROFILE, ReadBits, ReadRegisters, WriteCoils, WriteRegisters
from busmaster.protocols.modbus.handle import ModbusUnit, is_whole
from busmaster.registry import NodeKind, Option, Protocol, device_of

PROTOCOL = Protocol(
    profile=PROFILE,
    kinds=(
        NodeKind(
            "modbus",
            ModbusUnit,
            device_of("busmaster.protocols.modbus.device"),
            items="holding:100, input:100, coil:5, discrete:5 (addresses as sent, 0 to 65535); holding:100:10 (ten "
            "from there on); holding:100:float32 (int16 uint16 int32 uint32 float32 float64, most significant word "
            "first; :swapped behind it for the other order)",
            whole_numbers=is_whole,
            emulated=(Option("size", "whole"), Option("functions", "numbers"), Option("read_only", "numbers")),
            capture_id=7,
        ),
    ),
    commands={
        "read_bits": ReadBits,
        "read_registers": ReadRegisters,
        "write_coils": WriteCoils,
        "write_registers": WriteRegisters,
    },
    dialect=ModbusDialect,
)
