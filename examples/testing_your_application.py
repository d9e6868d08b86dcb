"""Test your application on an emulated line in virtual time: an hour in a fraction of a second.

    python examples/testing_your_application.py     or: python -m pytest examples/testing_your_application.py

The application is the same as in the plant: it gets a drive, sleeps and polls.
`busmaster.testing.fixtures` provides the same as pytest fixtures.
"""

import asyncio
import time

from busmaster import Bus, BusLike, MemoryPort, MicroFlexDrive
from busmaster.emulator.line import Line
from busmaster.protocols.hcp2.microflex_device import EmulatedMicroFlex
from busmaster.testing import run_in_virtual_time

# The application


async def guard(bus: BusLike, drive: MicroFlexDrive, limit: float) -> None:
    """Looks at the drive's temperature once a second, and disables it when that is above `limit`."""
    group = bus.poll_group("guard", period=1.0, points=[drive.temperature])
    try:
        async for snapshot in group:
            sample = snapshot[drive.temperature]
            if sample.error is None and sample.value > limit:
                await drive.disable()
                return
    finally:
        group.close()


# Its tests


def test_a_drive_that_gets_too_hot_is_disabled() -> None:
    async def scenario() -> None:
        async with Bus(MemoryPort(line)) as bus:
            drive = MicroFlexDrive(bus, 7)
            await drive.enable()
            await drive.set_torque_reference(100.0)
            await asyncio.wait_for(guard(bus, drive, limit=60.0), timeout=600)
        assert not emulated.enabled

    emulated = EmulatedMicroFlex(7, current_control=True)
    line = Line(MicroFlexDrive.profile.line, [emulated])
    run_in_virtual_time(scenario())


def test_a_drive_that_stays_cool_is_left_alone_for_an_hour() -> None:
    async def scenario() -> None:
        async with Bus(MemoryPort(line)) as bus:
            drive = MicroFlexDrive(bus, 7)
            await drive.enable()
            await drive.set_speed_reference(50.0)
            guarding = asyncio.ensure_future(guard(bus, drive, limit=60.0))
            await asyncio.sleep(3600)
            assert not guarding.done()
            assert emulated.enabled
            guarding.cancel()

    emulated = EmulatedMicroFlex(7)
    line = Line(MicroFlexDrive.profile.line, [emulated])
    run_in_virtual_time(scenario())


if __name__ == "__main__":
    test_a_drive_that_gets_too_hot_is_disabled()
    began = time.perf_counter()
    test_a_drive_that_stays_cool_is_left_alone_for_an_hour()
    took = time.perf_counter() - began
    print(f"an hour of the line in {took:.2f} s: {3600 / took:.0f} times real speed")
