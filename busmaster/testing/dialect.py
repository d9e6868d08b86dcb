"""The conformance kit for a protocol's listener: it checks that the listener decodes the conversation on the line.

    def test_the_dialect_decodes_the_conversation():
        check_dialect(PROTOCOL, CASES)

It uses the cases of `check_protocol`. For each case it checks the following, and raises `NotConformant` with all
faults.

- The bytes of host and node are split into the same frames in one chunk, one byte at a time, and with noise before.

- The request is a read or a write of that node without a fault. The command that the dialect makes from it sends the
  same bytes.

- The last step is the reply: a value, an acknowledgement, or a refusal if the case raises one.

- The command can be converted to JSON and back.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from busmaster.capture.decode import Decoder
from busmaster.contract.driver import Driver
from busmaster.contract.exchange import Command
from busmaster.contract.frames import Direction, Frame, Kind
from busmaster.errors import InvalidCommand
from busmaster.ext import Protocol
from busmaster.testing.cases import Case, NotConformant
from busmaster.testing.damage import bytewise

Transmission = tuple[Direction, bytes]
APART = 0.5
"""Seconds between noise and what follows it: longer than a listener waits for the rest of a frame."""
NOISE = b"\xff\xff"


def check_dialect(protocol: Protocol, cases: Iterable[Case]) -> None:
    """Raise NotConformant, with all faults of the protocol's dialect and of its commands in JSON."""
    findings = [f"{case}: {finding}" for case in cases for finding in _check(protocol, case)]
    if findings:
        raise NotConformant(protocol.name, findings)


def _check(protocol: Protocol, case: Case) -> Iterator[str]:
    transmissions = list(_conversation(protocol, case))
    frames = _hear(protocol, transmissions)
    pieces = [(sender, byte) for sender, data in transmissions for byte in bytewise(data)]
    if (found := _hear(protocol, pieces)) != frames:
        yield f"one byte at a time it is {_described(found)} instead of {_described(frames)}"
    if (found := _hear(protocol, transmissions, NOISE)) != frames:
        yield f"after noise it is {_described(found)} instead of {_described(frames)}"
    yield from _check_request(protocol, case, frames)
    if case.steps:
        yield from _check_answer(case, frames)
    yield from _check_written(protocol, case.command)


def _conversation(protocol: Protocol, case: Case) -> Iterator[Transmission]:
    """Yield the bytes of both sides, including the closing byte of the host."""
    driver = Driver(case.command.open(case.address, protocol.profile.timings))
    yield Direction.HOST, driver.exchange.request
    heard = 0
    for step in case.steps:
        yield Direction.NODE, step
        driver.feed(step)
        yield from ((Direction.HOST, word) for word in driver.sent[heard:])
        heard = len(driver.sent)
    ending = driver.ending
    if ending is not None and ending.send:
        yield Direction.HOST, ending.send


def _hear(protocol: Protocol, transmissions: Iterable[Transmission], noise: bytes = b"") -> list[Frame]:
    """Return the frames without their times, and without noise before them."""
    decoder = Decoder(protocol.dialect())
    frames = decoder.feed(noise, 0.0) if noise else []
    for sender, data in transmissions:
        frames += decoder.feed(data, APART, sender)
    frames = [frame for frame in frames + decoder.quiet() if not (noise and frame.raw == noise)]
    for frame in frames:
        frame.time, frame.delay = 0.0, None
    return frames


def _check_request(protocol: Protocol, case: Case, frames: Sequence[Frame]) -> Iterator[str]:
    profile = protocol.profile
    asked = case.command.open(case.address, profile.timings).request
    request = frames[0]
    wanted = Kind.WRITE if case.command.writes else Kind.READ
    if request.raw != asked or request.kind is not wanted or request.sender is not Direction.HOST or request.fault:
        yield f"its request {asked.hex(' ')} is {_described(frames[:1])}, not a {wanted.value} of the host"
        return
    if profile.addressed and request.node != case.address:
        yield f"its request is decoded as one to {request.node}"
    continued = [frame for frame in frames[1:] if frame.sender is Direction.HOST and frame.continues]
    try:
        command = protocol.dialect().command(request, continued)
        again = command.open(case.address, profile.timings).request
    except (InvalidCommand, ValueError, KeyError) as error:
        yield f"its request {_described(frames[:1])} gives no command: {error}"
        return
    if again != asked or (continued and str(command) != str(case.command)):
        yield f"its request is decoded as {command}, which sends {again.hex(' ')} instead of {asked.hex(' ')}"


def _check_answer(case: Case, frames: Sequence[Frame]) -> Iterator[str]:
    answers = [frame for frame in frames if frame.sender is Direction.NODE]
    if not answers or not answers[-1].answers or answers[-1].fault:
        yield f"its reply is {_described(answers[-1:])}, which does not end the request"
        return
    refused = answers[-1].kind in (Kind.NAK, Kind.EOT)
    if refused is not (case.raises is not None):
        yield f"its reply is {_described(answers[-1:])}, {'a refusal' if refused else 'not a refusal'}"


def _check_written(protocol: Protocol, command: Command[Any]) -> Iterator[str]:
    try:
        back = protocol.read_back(json.loads(json.dumps(protocol.write_down(command))))
    except (InvalidCommand, TypeError, ValueError) as error:
        yield f"it cannot be converted to JSON and back: {error}"
        return
    if back != command:
        yield f"it is converted to JSON, and back to {back!r}"


def _described(frames: Sequence[Frame]) -> str:
    return "; ".join(f"{f.kind.value} {f.text!r}" + (f" [{f.fault}]" if f.fault else "") for f in frames) or "nothing"
