"""Modbus RTU: registers and numbers of one unit, a group of two units, and an exception reply.

    python examples/modbus_hello.py [PORT]   such as /dev/ttyUSB0 or socket://10.0.0.5:4001; without one, emulated

With a PORT it writes holding registers 40 to 43 of unit 18.
"""

import sys

import anyio

from busmaster import Bus, BusLike, Endpoint, MemoryPort, ModbusUnit, Refused, endpoint
from busmaster.emulator.line import Line
from busmaster.registry import make_device

SETTINGS = ModbusUnit.profile.line  # 19200 8E1


async def main(bus: BusLike) -> None:
    press, oven = ModbusUnit(bus, 17), ModbusUnit(bus, 18)
    print("press:", await press.read("holding:7:3"))  # three registers, in one exchange
    await oven.write("holding:40:float32", 215.5, 220.25, verify=True)  # two numbers of two registers each
    print("oven:", await oven.read("holding:42:float32"))
    points = [oven.point("holding:40:float32"), press.point("coil:5")]
    async for snapshot in bus.poll_group("shop", period=0.1, points=points):
        print({point.key: sample.value for point, sample in snapshot.items()})
        break
    try:
        await press.read("input:60000")
    except Refused as refusal:
        print(refusal)


def emulated() -> MemoryPort:
    return MemoryPort(Line(SETTINGS, [make_device("modbus", unit) for unit in (17, 18)]))


async def on_port(port: Endpoint) -> None:
    async with Bus(port) as bus:
        await main(bus)


if __name__ == "__main__":
    anyio.run(on_port, endpoint(sys.argv[1], defaults=SETTINGS) if sys.argv[1:] else emulated())
