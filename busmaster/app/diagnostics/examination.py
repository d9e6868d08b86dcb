"""The steps of an examination: the port, its driver, the line without requests, and then the nodes."""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

import anyio.to_thread

from busmaster import Endpoint, LineDown, LineSettings, Rfc2217Port, SerialPort, TcpPort, Timings
from busmaster.app.diagnostics import adapters, diagnosis, uart
from busmaster.app.diagnostics.adapters import Finding
from busmaster.app.diagnostics.diagnosis import Record
from busmaster.app.diagnostics.probing import Outcome, Prober, Wire, opened
from busmaster.ext import Mark, Profile, Tap, find

OPENING = 0.05
"""Seconds in which opening a port may make noise."""
LISTENING = 0.5
ECHOING = 0.1
HARMLESS = bytes.fromhex("00 55 00")
"""Begins no frame of any protocol, and is not an acknowledgement: no node replies."""
PROBES = 24
"""Number of further requests to a node that replies."""
SILENT_PROBES = 3
"""Number of requests to a named node before it is reported as silent."""
TOLERANCE = 0.02
"""Largest relative difference of the rates of the two ends of a line: together less than half a bit in ten."""
STRANGERS = 4
"""Number of nodes that are tried at each setting."""
RATES = (9600, 19200, 38400, 57600, 115200, 4800, 2400)
FRAMINGS = ((8, "N"), (7, "E"), (8, "E"))

Report = Callable[[Finding], None]


class Progress(Protocol):
    """Is called for each step of a task with a known number of steps."""

    def advance(self) -> None: ...


class Unseen:
    """Progress without a display."""

    def advance(self) -> None:
        pass


Course: TypeAlias = Callable[[str, int], AbstractContextManager[Progress]]
"""Shows how far a course of so many steps is, for as long as it is entered."""


def unseen(_label: str, _steps: int) -> AbstractContextManager[Progress]:
    """Show nothing."""
    return nullcontext(Unseen())


@dataclass(frozen=True, slots=True)
class Patient:
    """The object of an examination. Without a protocol no requests are sent.

    `named`: the user has named the nodes. `progress` shows the progress of each task; by default nothing is shown.
    """

    endpoint: Endpoint
    protocol: str | None = None
    timings: Timings | None = None
    addresses: tuple[int, ...] = ()
    named: bool = False
    progress: Course = unseen

    @property
    def profile(self) -> Profile:
        assert self.protocol is not None
        return find(self.protocol).profile

    def crowd(self, addresses: Sequence[int]) -> str:
        """Return how nodes that do not answer are spoken of."""
        if len(addresses) == 1:
            return self.profile.label(addresses[0])
        if len(addresses) > 2 * STRANGERS:
            return f"any of {len(addresses)} addresses"
        return f"nodes {', '.join(str(address) for address in addresses)}"


async def examine(patient: Patient, report: Report, tap: Tap | None = None) -> None:
    """Report all findings, in this order. A finding that makes the others pointless is the last."""
    where = patient.endpoint
    if isinstance(where, SerialPort):
        inspect = functools.partial(adapters.inspect, where.path, low_latency=where.low_latency)
        found = await anyio.to_thread.run_sync(inspect)
        for finding in found:
            report(finding)
        if not all(finding.ok for finding in found if finding.topic in ("port", "permission", "holders")):
            return
    if isinstance(where, TcpPort):
        what = "the adapter checks do not apply to a TCP port"
        advice = "check the server's own: line settings, and bytes passed on at once (ser2net: chardelay: false)"
        report(Finding("adapter", True, what, advice))
    try:
        async with opened(where, tap) as wire:
            for finding in opening(patient, wire):
                report(finding)
            if isinstance(where, SerialPort) and where.low_latency:
                for finding in await anyio.to_thread.run_sync(_opened_latency, wire):
                    report(finding)
            await examine_line(patient, wire, report)
    except LineDown as error:
        report(Finding("port", False, error.what, error.hint))


def _opened_latency(wire: Wire) -> list[Finding]:
    assert wire.transport is not None
    return list(adapters.opened_latency(wire.transport.get_extra_info("serial").port))


def opening(patient: Patient, wire: Wire) -> Iterator[Finding]:
    """Return the findings about an open port."""
    where = patient.endpoint
    assert wire.transport is not None
    profile = None if patient.protocol is None else patient.profile
    advice = "" if profile is None or where.settings is None else profile.wrong_rate(where.settings.baudrate)
    if where.settings is None or (isinstance(where, TcpPort) and not isinstance(where, Rfc2217Port)):
        yield Finding("open", True, "it opens", advice)
        return
    if profile is not None and where.settings != profile.line:
        advice = advice or f"{profile.title} usually has {diagnosis.speed(profile.line)}"
    yield Finding("open", True, f"it opens at {diagnosis.speed(where.settings)}", advice)
    device = wire.transport.get_extra_info("serial")
    if isinstance(where, Rfc2217Port):
        yield from remote_port(wire.transport)
    if device is not None:
        yield from rate(device.fileno(), where.settings.baudrate)
        serial = where if isinstance(where, SerialPort) else None
        yield from driver(
            device.fileno(),
            None if serial is None else serial.low_latency,
            switched=serial is not None and serial.rts is not None and serial.rts.by == "software",
        )


def rate(descriptor: int, baudrate: int) -> Iterator[Finding]:
    """Return whether the UART can make the baud rate, if its driver reports that."""
    made = adapters.made_rate(descriptor, baudrate)
    if made is not None and abs(made / baudrate - 1) > TOLERANCE:
        what = f"its UART makes {made:.0f} baud of {baudrate}, {made / baudrate - 1:+.1%}"
        yield Finding(
            "rate", False, what, "use a rate that it can make, or another adapter: both ends may differ by 2%"
        )


def remote_port(transport: asyncio.Transport) -> Iterator[Finding]:
    """Return the findings from an RFC 2217 server about its port."""
    if transport.get_extra_info("line_errors")() is None:
        advice = "parity and framing errors are not counted: each shows as a garbled reply, if its checksum finds it"
        yield Finding("line errors", True, "the server has not confirmed that it reports line errors", advice)
    else:
        yield Finding("line errors", True, "the server reports line errors")
    lines = transport.get_extra_info("modem_lines")
    if lines is not None:
        states = ", ".join(f"{name.upper()} {'on' if on else 'off'}" for name, on in lines._asdict().items())
        yield Finding("modem lines", True, f"the server reports {states}")


def driver(descriptor: int, wanted: bool | None = None, *, switched: bool = False) -> Iterator[Finding]:
    """Return the state of an open serial port's driver. `wanted` is the low-latency flag with which it was opened.

    `switched`: software switches the transmitter.
    """
    match adapters.low_latency(descriptor):
        case None:
            yield Finding("driver", True, "it has no low-latency flag")
        case True:
            yield Finding("driver", True, "its low-latency flag is set")
        case False if wanted:
            yield Finding("driver", True, "its low-latency flag is not set, although low_latency=1 was given")
        case False:
            advice = "?low_latency=1 may bring replies sooner" if wanted is None else ""
            yield Finding("driver", True, "its low-latency flag is not set", advice)
    match adapters.rs485_mode(descriptor):
        case _ if switched:
            yield Finding("rs485", True, "software switches the transmitter by RTS")
        case None:
            yield Finding("rs485", True, "the driver has no RS-485 mode: the adapter switches by itself, or is RS-232")
        case True:
            yield Finding("rs485", True, "the driver switches the transmitter (RS-485 mode)")
        case False:
            yield Finding(
                "rs485",
                True,
                "the driver's RS-485 mode is off",
                "if nothing is answered and this is a bare transceiver that needs RTS, add ?rs485=1 (rs485=True in "
                "Python), or ?rs485.by=software if the driver knows the mode and still refuses it",
            )


async def examine_line(patient: Patient, wire: Wire, report: Report) -> None:
    """Report the findings on an open line. A finding that makes the others pointless is the last."""
    where = patient.endpoint
    assert wire.port is not None
    await wire.hear_all(OPENING)
    wire.port.reset()
    wire.marked.clear()
    heard = await wire.hear_all(LISTENING)
    talk = diagnosis.unexpected(heard, patient.protocol)
    report(talk)
    # A possible master must not be disturbed. Noise does not prevent requests.
    if heard and (patient.protocol is None or diagnosis.known_frames(heard, patient.protocol)):
        return
    settings = where.settings
    byte_time = 0.0 if settings is None else settings.byte_time
    wire.send(HARMLESS)
    heard = await wire.hear_all(ECHOING + len(HARMLESS) * byte_time + where.receive_latency)
    report(diagnosis.echo(HARMLESS, heard, where.echo))
    if patient.protocol is None:
        report(Finding("nodes", True, "no request was sent", "name the protocol with --protocol, and perhaps --nodes"))
        return
    profile = patient.profile
    timings = profile.timings if patient.timings is None else patient.timings
    byte_time = (profile.line if settings is None else settings).byte_time
    prober = Prober(wire, profile, timings, byte_time, echo=heard.startswith(HARMLESS))
    records = await ask_all(patient, prober)
    for finding in uart.findings(wire.marked[Mark.DAMAGED], wire.marked[Mark.BREAK], wire.port.errors()):
        report(finding)
    if isinstance(where, SerialPort) and where.rts is not None:
        assert wire.transport is not None
        starts = [start for record in records for start in record.starts]
        released = wire.transport.get_extra_info("released")
        for finding in diagnosis.turnaround(starts, released, byte_time if wire.paced else 0.0):
            report(finding)
    if any(record.lives for record in records):
        for finding in diagnosis.nodes(records, timings.read):
            report(finding)
    else:
        report(diagnosis.nobody(patient.crowd(patient.addresses), profile, settings))
    if not any(record.answers for record in records):
        await try_settings(patient, wire, prober, report)


async def ask_all(patient: Patient, prober: Prober) -> list[Record]:
    """Send a request to every address, and further ones to nodes that reply. Leaves out silent nodes without a name."""
    records = []
    label = patient.profile.label
    with patient.progress("asking", len(patient.addresses)) as bar:
        for address in patient.addresses:
            probes = [await prober.ask(address, alone=True)]
            while patient.named and probes[-1].outcome is Outcome.SILENT and len(probes) < SILENT_PROBES:
                probes.append(await prober.ask(address, alone=True))
            record = Record(address, label(address), probes)
            if record.lives or patient.named:
                records.append(record)
            bar.advance()
    living = [record for record in records if record.lives]
    with patient.progress("measuring", len(living) * PROBES) as bar:
        for record in living:
            for left in reversed(range(PROBES)):
                # The last one waits out the maximum reply delay, so that nothing of this node is left for the next.
                record.probes.append(await prober.ask(record.address, alone=not left))
                bar.advance()
    return records


async def try_settings(patient: Patient, wire: Wire, prober: Prober, report: Report) -> None:
    """Try, because no node replies, whether one does at another rate or framing. Restores the port's settings."""
    where = patient.endpoint
    settings = where.settings
    if not wire.tunable or settings is None:
        return
    if not wire.paced and not isinstance(where, Rfc2217Port):
        report(Finding("settings", True, "a pseudo-terminal has no baud rate: no other was tried"))
        return
    asked = patient.addresses[:STRANGERS]
    candidates = other_settings(settings)
    patience = patient.profile.timings.read.window
    try:
        with patient.progress("trying rates", len(candidates)) as bar:
            for candidate in candidates:
                found = await answers_at(candidate, wire, prober, asked, patience)
                bar.advance()
                if found is not None:
                    break
    finally:
        with anyio.CancelScope(shield=True), contextlib.suppress(LineDown):
            await wire.tune(settings)
    report(diagnosis.other_rate(found, candidate, patient.crowd(asked), len(candidates)))


async def answers_at(
    settings: LineSettings, wire: Wire, prober: Prober, asked: Sequence[int], patience: float
) -> int | None:
    """Return the first node that answers with these settings; None too where the port does not take them."""
    try:
        await wire.tune(settings)
    except LineDown:
        return None
    prober.byte_time = settings.byte_time
    for address in asked:
        if (await prober.ask(address, patience=patience)).outcome is Outcome.ANSWERED:
            return address
    return None


def other_settings(settings: LineSettings) -> list[LineSettings]:
    """Return other rates with this framing first, then other framings."""
    own = (settings.bytesize, settings.parity)
    framings = [own, *(framing for framing in FRAMINGS if framing != own)]
    tried = (
        replace(settings, baudrate=rate, bytesize=bits, parity=parity)
        for bits, parity in framings
        for rate in (settings.baudrate, *RATES)
    )
    return [candidate for candidate in dict.fromkeys(tried) if candidate != settings]
