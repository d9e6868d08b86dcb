"""Devices by the name of their protocol, as the command line and LINE.toml ask for them."""

from __future__ import annotations

from collections.abc import Callable

from busmaster.emulator.device import Delay, Device
from busmaster.emulator.devices.dc104 import Dc104Drive
from busmaster.emulator.devices.hostcomms import HCP, HCP2, Framing
from busmaster.emulator.devices.mentor import SPEED_REFERENCE, MentorDrive
from busmaster.emulator.devices.microflex import ENABLE, MicroFlexDrive
from busmaster.emulator.devices.mint import MintController, report_positions
from busmaster.emulator.devices.msc import RUN_FLAG, MscController
from busmaster.emulator.oracle import Oracle
from busmaster.errors import InvalidCommand

Maker = Callable[[int, Delay, Oracle | None, bool], Device]


def make_device(
    protocol: str,
    address: int,
    *,
    delay: Delay | None = None,
    oracle: Oracle | None = None,
    lively: bool = False,
) -> Device:
    """An emulated slave: `protocol` is hcp, hcp2, microflex, msc, mentor or dc104.

    `lively`: something moves on it from the start. `oracle`: every value is the oracle's, whose modulus must be one
    that the protocol can carry.
    Raises InvalidCommand for a protocol that does not exist.
    """
    maker = MAKERS.get(protocol)
    if maker is None:
        raise InvalidCommand(f"no such protocol {protocol!r}: use {' '.join(MAKERS)}")
    return maker(address, Delay() if delay is None else delay, oracle, lively)


def _mint(framing: Framing) -> Maker:
    def make(address: int, delay: Delay, oracle: Oracle | None, lively: bool) -> Device:
        controller = MintController(address, framing, delay=delay, oracle=oracle)
        if lively:
            controller.program = report_positions
            controller.statement = 0.05
            controller.start_program()
            for number, axis in enumerate(controller.axes):
                axis.swing(100.0, 8.0 + number, address / 7 + number / 3, 0.0)
        return controller

    return make


def _microflex(address: int, delay: Delay, oracle: Oracle | None, lively: bool) -> Device:
    drive = MicroFlexDrive(address, delay=delay, oracle=oracle)
    if lively:
        drive.ripple = 0.01
        drive.speed_reference = 20.0 + 5 * (address % 8)
        drive.command(ENABLE, 0.0)
    return drive


def _msc(address: int, delay: Delay, oracle: Oracle | None, lively: bool) -> Device:
    controller = MscController(address, delay=delay, oracle=oracle)
    if lively:
        controller.flags.add(RUN_FLAG)
    return controller


def _mentor(address: int, delay: Delay, oracle: Oracle | None, lively: bool) -> Device:
    drive = MentorDrive(address, delay=delay, oracle=oracle)
    if lively:
        drive.ripple = 0.01
        drive.set_value(SPEED_REFERENCE, 313 + 50 * (address % 8), 0.0)
    return drive


def _dc104(address: int, delay: Delay, oracle: Oracle | None, lively: bool) -> Device:
    return Dc104Drive(address, delay=delay, oracle=oracle, lively=lively)


MAKERS: dict[str, Maker] = {
    "hcp": _mint(HCP),
    "hcp2": _mint(HCP2),
    "microflex": _microflex,
    "msc": _msc,
    "mentor": _mentor,
    "dc104": _dc104,
}
