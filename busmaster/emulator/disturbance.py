"""Applies faults: to the bytes that a device receives, and to transmitted frames."""

from __future__ import annotations

from busmaster.emulator.chance import Chance
from busmaster.emulator.device import Device
from busmaster.emulator.faults import FORGED, NO_NOISE, Faults


def misses(device: Device, start: float, end: float, request: bool, chance: Chance) -> bool:
    """Return True if `device` misses the bytes on the line from `start` to `end`. `request`: a whole frame addressed to
    it."""
    if start < device.away_until:
        return True
    faults = device.faults
    device.lag = 0.0
    for name, rate in faults.hearing:
        if name == "dead":
            return True
        if (name != "drop" and not request) or chance.random() >= rate:
            continue
        match name:
            case "drop":
                if start < device.free_at:
                    return True
            case "deaf":
                return True
            case "flapping" | "restart":
                if name == "restart":
                    device.restart(end)
                device.away_until = end + chance.uniform(0.0, faults.away_for)
                return True
            case "nak":
                device.reply(device.refusal, end)
                return True
            case "late":
                device.lag = chance.uniform(0.0, faults.late_by)
    return False


Transmission = tuple[float, bytes, int]
"""When it starts, the bytes, and the chunks they reach the host in (0: as the line does it)."""


def distort(
    faults: Faults, transmission: Transmission, device: Device | None, tau: float, chance: Chance
) -> list[Transmission]:
    """Return what becomes of a frame transmitted by `device` (None: the host): possibly nothing, possibly several
    frames."""
    start, data, chunk = transmission
    more: list[Transmission] = []
    for name, rate in faults.speaking:
        if chance.random() >= rate:
            continue
        match name:
            case "lost":
                return []
            case "wrong":
                data = data if device is None else device.disguise(data, chance)
            case "truncated":
                data = data[: chance.randrange(0, len(data))]
            case "flip":
                data = flipped(data, chance, 1)
            case "unseen":
                data = flipped(data, chance, 2)
            case "doubled":
                data += data
            case "leading":
                data = noise(chance, 3) + data
            case "trailing":
                data += noise(chance, 3)
            case "repeated":
                more.append((start + len(data) * tau + chance.uniform(0.005, 0.3), data, 0))
            case "duplicate":
                again = 0.002 if device is None else device.delay.draw(chance)
                more.append((start + chance.uniform(0.0, 2 * again), data, 0))
            case "forged":
                at = chance.randrange(0, len(FORGED))
                data = FORGED[at : at + 1] + data
            case "babble":
                more.append((start + chance.uniform(0.0, 0.1), noise(chance, 60), 0))
            case "split":
                chunk = chance.randrange(1, 5)
    return [(start, data, chunk), *more] if data else more


def noise(chance: Chance, longest: int) -> bytes:
    """Return one to `longest` bytes as a disturbed line makes them.

    They are all zeros, all ones, or anything but `NO_NOISE`, now and then behind an STX, as if it were a telegram.
    """
    kind = chance.randrange(0, 4)
    count = chance.randrange(1, longest + 1)
    if kind < 2:
        return (b"\x00", b"\xff")[kind] * count
    burst = bytes(chance.getrandbits(8) for _ in range(count)).translate(None, NO_NOISE) or b"\xff"
    return burst if kind == 2 else (b"\x02" + burst)[:longest]


def flipped(data: bytes, chance: Chance, count: int) -> bytes:
    """Return the data with the same bit flipped in `count` bytes; in all of them if there are fewer."""
    mask = 1 << chance.randrange(0, 8)  # the same bit in all: an exclusive-or does not detect two flips of one bit (R5)
    changed = bytearray(data)
    places = list(range(len(data)))
    for _ in range(min(count, len(places))):
        changed[places.pop(chance.randrange(0, len(places)))] ^= mask
    return bytes(changed)
