"""The wire: half-duplex, with the time of each byte. All devices receive every byte. The caller passes the time.

The host's side uses a few calls, in virtual or in real time:

    line.send(data, now)      the host transmits, or continues after the bytes that it is still transmitting
    line.next_event()         the time of the next call, unless the host sends before
    line.receive(now)         the bytes that have reached the host's port by now
    line.cut(now)             and line.restore(now)

Time never runs backwards. Calls that are early or repeated have no effect.

Theory of operation. A *talk* is a run of contiguous bytes by one talker. `_active` is the talk on the wire, or the next
one; `_pending` contains those that start later. An undisturbed talk stays one piece. The devices receive it as a whole
after its last byte. The host receives parts of it earlier if it calls `receive` earlier. If a talk starts while another
is on the wire, both are converted to the bits of a `Collision`. The devices receive these bits after the end of the
collision. With `paced` False bytes take no time, and talks never overlap.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from heapq import heapify, heappop, heappush

from busmaster.contract.profile import LineSettings
from busmaster.emulator.chance import Chance, NoChance
from busmaster.emulator.collision import Collision
from busmaster.emulator.device import NEVER, Device
from busmaster.emulator.disturbance import Transmission, distort, flipped, misses
from busmaster.emulator.faults import Faults
from busmaster.emulator.misheard import misheard

PIECE = 0.005
"""Seconds of a frame that a port hands over at once."""
ROUNDING = 1e-6
"""Of a byte: times are floats."""

Send = Callable[[Device, float, bytes], None]
"""A device will transmit: the start time and the bytes."""
TakeBack = Callable[[Device, float], None]
"""A device has restarted at this time: its pending transmissions are discarded."""


class AttachedDevices:
    """The devices of a line. `send` is called with their replies, `take_back` after a restart.

    Every device receives every byte. An undisturbed frame of the host is passed in one piece to the device with a
    matching route; the other devices receive it only if they are attentive. Incomplete, corrupted or joined frames are
    passed to all devices byte by byte. If they contain no byte with which a route begins, they cannot change the state
    of an idle device, and are passed to attentive devices only.
    """

    def __init__(self, send: Send, take_back: TakeBack, chance: Chance, tau: float) -> None:
        self.devices: list[Device] = []
        self.wakeup = NEVER
        """Earliest time at which a device must be woken."""
        self.cut_off: frozenset[Device] = frozenset()
        self._send = send
        self._take_back = take_back
        self._chance = chance
        self._tau = tau
        self._routes: dict[bytes, tuple[Device, ...]] = {}
        self._route_sizes: tuple[int, ...] = ()
        self._openers: frozenset[int] = frozenset()
        self._attentive: dict[Device, None] = {}

    def add(self, device: Device) -> None:
        """Attach a device, which then uses the line's time and random source."""
        device.tau = self._tau
        device.chance = self._chance
        self.devices.append(device)
        self._learn_routes()
        self._note(device, 0.0)

    def remove(self, device: Device) -> None:
        """Detach a device. Raises ValueError if it is not attached."""
        self.devices.remove(device)
        self._attentive.pop(device, None)
        self._learn_routes()

    def request(self, frame: bytes, start: float, end: float) -> None:
        """Process an undisturbed frame of the host, on the line from `start` to `end`."""
        for size in self._route_sizes:
            routed = self._routes.get(frame[:size])
            if routed is not None:
                break
        else:
            self.overhear(frame, start, end, None, whole=False)
            return
        left: list[Device] = []
        # Also while the device is attentive, as a Mentor II drive is after a read: byte by byte to all would be slow.
        for device in routed:
            if device in self.cut_off or (self._faulty(device) and misses(device, start, end, True, self._chance)):
                self._note(device, end)
            elif not device.take(frame, end):
                left.append(device)
            else:
                self._note(device, end)
        if left:
            left += [device for device in self.devices if device not in routed]
            self.hear(left, frame, start, end)
        elif self._attentive:
            self.hear([device for device in self._attentive if device not in routed], frame, start, end)

    def overhear(self, data: bytes, start: float, end: float, talker: Device | None, whole: bool) -> None:
        """Process bytes that are not a request in one piece.

        With `whole` they are a reply in one piece, which does not begin with a route.
        """
        if whole or self._openers.isdisjoint(data):
            if not self._attentive:
                return
            listeners: Iterable[Device] = tuple(self._attentive)
        else:
            listeners = self.devices
        self.hear([device for device in listeners if device is not talker], data, start, end)

    def scatter(self, collision: Collision, end: float) -> None:
        """Pass the result of a collision to each device, except for its own transmission time."""
        for device in self.devices:
            for start, byte in collision.heard(device):
                self.hear((device,), bytes((byte,)), start, end)

    def wake(self) -> None:
        """Wake the devices whose wake-up time has been reached."""
        now = self.wakeup
        self.wakeup = NEVER
        for device in self.devices:
            if device.wakeup <= now:
                device.wake(now)
                self._note(device, now)
            elif device.wakeup < self.wakeup:
                self.wakeup = device.wakeup

    def restart(self, device: Device, now: float) -> None:
        """Restart a device at `now`."""
        device.restart(now)
        self._note(device, now)

    def hear(self, listeners: Iterable[Device], data: bytes, start: float, now: float) -> None:
        """Pass `data` to `listeners` byte by byte; its last byte ended at `now`."""
        for device in listeners:
            if device in self.cut_off:
                continue
            if not self._faulty(device) or not misses(device, start, now, False, self._chance):
                device.hear(data, start)
            self._note(device, now)

    @staticmethod
    def _faulty(device: Device) -> bool:
        return bool(device.faults.hearing) or device.away_until > 0.0

    def _note(self, device: Device, now: float) -> None:
        """Collect its replies, whether it must receive every byte from now on, and the time at which to wake it."""
        if device.restarted:
            device.restarted = False
            self._take_back(device, now)
        if device.outbox:
            replies = device.outbox
            device.outbox = []
            if now >= device.away_until and not device.faults.dead:
                for start, data in replies:
                    self._send(device, start if start > now else now, data)
        device.lag = 0.0
        if device.attentive:
            self._attentive[device] = None
        elif self._attentive:
            self._attentive.pop(device, None)
        if device.wakeup < self.wakeup:
            self.wakeup = device.wakeup

    def _learn_routes(self) -> None:
        routes: dict[bytes, tuple[Device, ...]] = {}
        for device in self.devices:
            for route in device.routes:
                routes[route] = (*routes.get(route, ()), device)
        self._routes = routes
        self._route_sizes = tuple(sorted({len(route) for route in routes}, reverse=True))
        self._openers = frozenset(route[0] for route in routes)


@dataclass(frozen=True, slots=True)
class Echo:
    """The host receives its own transmissions, `delay` seconds late; each frame with probability `corrupt` with a
    flipped bit."""

    delay: float = 0.0
    corrupt: float = 0.0


class Talk:
    """A contiguous transmission of one sender (None: the host). `given`: number of bytes already delivered to the
    host."""

    __slots__ = ("chunk", "clean", "collision", "data", "end", "given", "start", "talker")

    def __init__(self, talker: Device | None, start: float, end: float, data: bytes, clean: bool, chunk: int) -> None:
        self.talker = talker
        self.start = start
        self.end = end
        self.data = data
        self.clean = clean
        self.chunk = chunk
        self.given = 0
        self.collision: Collision | None = None


class Line:
    """A line with `devices` on it. `faults` strike every frame, the host's too.

    `chance` is a seeded random.Random: necessary if a delay or a fault is random, or if talkers collide. `chunk` bytes
    at a time reach the host (0: whole frames, unless it calls `receive` before), `latency` seconds after they were on
    the wire. `driver_release_time`: for how long the host's driver still holds the line after its last byte.
    `paced` False: bytes take no time.
    """

    def __init__(
        self,
        settings: LineSettings,
        devices: Iterable[Device] = (),
        *,
        chance: Chance | None = None,
        faults: Faults | None = None,
        paced: bool = True,
        echo: Echo | None = None,
        chunk: int = 0,
        latency: float = 0.0,
        driver_release_time: float = 0.0,
    ) -> None:
        self.settings = settings
        self.tau = settings.byte_time if paced else 0.0
        self._rounding = self.tau * ROUNDING
        self.chance: Chance = NoChance() if chance is None else chance
        self.faults = Faults() if faults is None else faults
        self.echo = echo
        self.chunk = chunk
        self.latency = latency
        self.driver_release_time = driver_release_time
        self.paced = paced
        """Whether the host may rely on the baud rate (R4). Set it to False for a line behind a network: its bytes have
        their duration on the wire, but can arrive at any time."""
        self.prompt = True
        """A frame's first byte is an event of its own, and so is each piece of a long one, as on a real port.

        Not necessary if the host calls `receive` at each of its deadlines.
        """
        self.host: LineSettings | None = None
        """The settings of the host's port, if they differ from those of the line. Both sides then receive wrong bytes.
        Devices drop bytes with a wrong parity or stop bit; the host's port delivers them."""
        self._piece = max(1, int(PIECE / self.tau)) if self.tau else 0
        self.collisions = 0
        """Talks that started while another was on the wire."""
        self._active: Talk | None = None
        self._pending: list[tuple[float, int, Talk]] = []
        self._order = 0
        self._fixing: Talk | None = None
        self._sent_by = 0.0
        self._held_until = 0.0
        self._holder: Device | None = None
        self._inbox = b""
        self._arrived = 0.0
        self._arrivals: deque[tuple[float, bytes]] = deque()
        self._attached = AttachedDevices(self._transmit, self._take_back, self.chance, self.tau)
        for device in devices:
            self.add(device)

    # Devices

    @property
    def devices(self) -> list[Device]:
        """Return the devices on the line."""
        return self._attached.devices

    def add(self, device: Device) -> None:
        """Attach a device. Two devices may have the same address: then both reply, and collide."""
        self._attached.add(device)

    def remove(self, device: Device) -> None:
        """Detach a device. Raises ValueError if it is not on the line."""
        self._attached.remove(device)

    def device(self, address: int) -> Device:
        """Return the first device with that address. Raises KeyError if there is none."""
        for device in self.devices:
            if device.address == address:
                return device
        raise KeyError(address)

    def restart(self, device: Device, now: float) -> None:
        """Switch a device off and on again: the content of its RAM is lost."""
        self._advance(now)
        self._attached.restart(device, now)

    def cut(self, now: float, *devices: Device) -> None:
        """Disconnect `devices` (by default all). Their current transmissions and receptions end immediately."""
        self._advance(now)
        lost = devices or tuple(self.devices)
        self._fixing = None
        talk = self._active
        if talk is not None and talk.start < now:
            self._give(talk, now)
            if talk.talker is None and talk.collision is None:
                self._attached.hear(lost, talk.data[: self._count(talk, now)], talk.start, now)
        self._attached.cut_off |= frozenset(lost)
        if talk is not None and (talk.talker in lost or talk.collision is not None):
            self._active = None
        self._pending = [entry for entry in self._pending if entry[2].talker not in lost]
        heapify(self._pending)
        if self._active is None and self._pending:
            self._activate(heappop(self._pending)[2])

    def restore(self, now: float) -> None:
        """Reconnect all devices. They do not receive the frame that the host is transmitting."""
        self._advance(now)
        talk = self._active
        if talk is not None and talk.talker is None and talk.start < now:
            self._fixing = talk
        else:
            self._attached.cut_off = frozenset()

    # Calls of the host

    def send(self, data: bytes, now: float) -> None:
        """Have the host transmit `data`, after the bytes that it is still transmitting."""
        self._advance(now)
        start = now if now > self._sent_by else self._sent_by
        if self.host is not None:
            data = self._as_devices_hear(data, start)
        self._sent_by = start + len(data) * self.tau
        self._transmit(None, start, data)

    def receive(self, now: float) -> bytes:
        """Return the bytes that have completely arrived at the host's port by `now` and were not delivered before."""
        self._advance(now)
        talk = self._active
        if talk is not None and talk.start < now:
            self._give(talk, now)
        arrivals = self._arrivals
        while arrivals and arrivals[0][0] <= now:
            self._inbox += arrivals.popleft()[1]
        data = self._inbox
        if data:
            self._inbox = b""
        return data

    def next_event(self) -> float:
        """Return the time of the next event, within the line or not yet seen by the host; NEVER if there is none."""
        if self._inbox:
            return self._arrived
        when = self._attached.wakeup
        talk = self._active
        if talk is not None:
            end = talk.end
            chunk = talk.chunk or self.chunk
            if self.prompt:  # in pieces: a pause as long as a long frame would look like its end
                chunk = min(chunk or self._piece, self._piece) if talk.given else 1
            if talk.collision is not None:
                # If a stray byte arrived only with the end of the host's request, it would look like the reply.
                end = min(end, self._next_byte(talk.collision, talk.given))
            elif chunk and self._heard_at_once(talk):
                end = min(end, talk.start + (talk.given + chunk) * self.tau)
            pending = self._pending
            if pending and pending[0][0] < talk.end - self._rounding:
                end = min(end, pending[0][0])
            if end < when:
                when = end
        if self._arrivals and self._arrivals[0][0] < when:
            when = self._arrivals[0][0]
        return when

    # Talks begin, meet and end

    def _transmit(self, talker: Device | None, start: float, data: bytes) -> None:
        if not self.faults.speaking and (talker is None or not talker.faults.speaking):
            self._join(Talk(talker, start, start + len(data) * self.tau, data, True, 0))
            return
        transmissions: list[Transmission] = [(start, data, 0)]
        if talker is not None:
            transmissions = distort(talker.faults, transmissions[0], talker, self.tau, self.chance)
        for one in transmissions:
            for begin, some, chunk in distort(self.faults, one, talker, self.tau, self.chance):
                clean = begin == start and some == data
                self._join(Talk(talker, begin, begin + len(some) * self.tau, some, clean, chunk))

    def _join(self, talk: Talk) -> None:
        if talk.talker in self._attached.cut_off:
            return
        active = self._active
        if active is None:
            self._activate(talk)
            return
        if talk.start < active.start:
            active.collision = None
            self._activate(talk)
            talk = active
        self._order += 1
        heappush(self._pending, (talk.start, self._order, talk))

    def _take_back(self, talker: Device, now: float) -> None:
        """Discard the talks of `talker`, which restarted at `now`, that have not begun by then."""
        self._pending = [entry for entry in self._pending if entry[2].talker is not talker]
        heapify(self._pending)
        talk = self._active
        if talk is not None and talk.talker is talker and talk.start >= now and talk.collision is None:
            self._active = None
            if self._pending:
                self._activate(heappop(self._pending)[2])

    def _activate(self, talk: Talk) -> None:
        self._active = talk
        if talk.start < self._held_until and talk.talker is not self._holder:
            talk.collision = Collision(self.settings, talk.start, self.chance)
            talk.collision.add(talk.start, b"", self._holder, self._held_until - talk.start)
            talk.collision.add(talk.start, talk.data, talk.talker, self._hold(talk))

    def _advance(self, now: float) -> None:
        """Process all events up to `now`, in order."""
        attached = self._attached
        while True:
            talk = self._active
            due = NEVER if talk is None else talk.end
            pending = self._pending
            overlap = False
            # Talks back to back do not overlap, although rounding may make it look so.
            if pending and pending[0][0] < due - self._rounding:
                overlap, due = True, pending[0][0]
            if attached.wakeup < due:
                if attached.wakeup > now:
                    return
                attached.wake()
            elif due > now or talk is None:
                return
            elif overlap:
                self._collide(talk, heappop(pending)[2])
            else:
                self._finish(talk)

    def _collide(self, talk: Talk, other: Talk) -> None:
        self.collisions += 1
        if talk.collision is None:
            talk.collision = Collision(self.settings, talk.start, self.chance)
            talk.collision.add(talk.start, talk.data, talk.talker, self._hold(talk))
        talk.collision.add(other.start, other.data, other.talker, self._hold(other))
        talk.end = max(talk.end, other.end)

    def _finish(self, talk: Talk) -> None:
        talker = talk.talker
        if self.driver_release_time if talker is None else talker.driver_release_time:
            self._held_until = talk.end + self._hold(talk)
            self._holder = talker
        self._active = None
        if self._pending:
            self._activate(heappop(self._pending)[2])
        self._reach_host(talk)
        if talk.collision is not None:
            self._attached.scatter(talk.collision, talk.end)
        elif talker is None and talk.clean:
            self._attached.request(talk.data, talk.start, talk.end)
        else:
            self._attached.overhear(talk.data, talk.start, talk.end, talker, talk.clean)
        if talk is self._fixing:
            self._fixing = None
            self._attached.cut_off = frozenset()

    def _hold(self, talk: Talk) -> float:
        return self.driver_release_time if talk.talker is None else talk.talker.driver_release_time

    # Bytes for the host

    def _as_devices_hear(self, data: bytes, start: float) -> bytes:
        """Echo `data` to a host whose port has other settings, and return the bytes that the devices receive."""
        assert self.host is not None
        if self.echo is not None:
            self._arrive(data, start + (len(data) * self.host.byte_time if self.tau else 0.0) + self.echo.delay)
        return bytes(byte for byte, whole in misheard(data, self.host, self.settings) if whole)

    def _heard_at_once(self, talk: Talk) -> bool:
        """Return True if the host receives it byte by byte. With other port settings it is calculated as a whole."""
        if self.host is not None:
            return False
        return talk.talker is not None or (self.echo is not None and not self.echo.delay and not self.echo.corrupt)

    def _count(self, talk: Talk, now: float) -> int:
        """Return the number of its bytes that have ended."""
        return min(len(talk.data), int((now - talk.start) / self.tau + ROUNDING)) if self.tau else len(talk.data)

    def _give(self, talk: Talk, now: float) -> None:
        """Deliver the bytes that have ended to the host."""
        if talk.collision is not None:
            data = self._host_hears(talk.collision, now)[talk.given :]
        elif self._heard_at_once(talk):
            data = talk.data[talk.given : self._count(talk, now)]
        else:
            return
        talk.given += len(data)
        self._arrive(data, now)

    def _reach_host(self, talk: Talk) -> None:
        """Deliver the remaining bytes to the host."""
        if talk.collision is not None:
            self._arrive(self._host_hears(talk.collision, NEVER)[talk.given :], talk.end)
        elif talk.talker is not None:
            data = talk.data[talk.given :]
            if self.host is not None:
                data = bytes(byte for byte, _ in misheard(data, self.settings, self.host))
            self._arrive(data, talk.end)
        elif self.echo is not None and self.host is None:
            data = talk.data[talk.given :]
            if self.echo.corrupt and self.chance.random() < self.echo.corrupt:
                data = flipped(data, self.chance, 1)
            self._arrive(data, talk.end + self.echo.delay)

    def _host_hears(self, collision: Collision, until: float) -> bytes:
        return bytes(byte for _, byte in collision.heard(None, until, echo=self.echo is not None))

    def _next_byte(self, collision: Collision, given: int) -> float:
        """Return the time at which the host has received the next byte of a collision, one byte at a time."""
        begins = [start for start, _ in collision.heard(None, echo=self.echo is not None)]
        return begins[given] + self.tau if given < len(begins) else NEVER

    def _arrive(self, data: bytes, when: float) -> None:
        arrivals = self._arrivals
        if not data:
            return
        if self.latency or self.echo is not None or arrivals:
            when += self.latency
            if arrivals and arrivals[-1][0] > when:  # a late echo still comes before the reply
                when = arrivals[-1][0]
            arrivals.append((when, data))
        else:
            self._inbox += data
            self._arrived = when


__all__ = [
    "PIECE",
    "ROUNDING",
    "Echo",
    "Line",
    "Talk",
]
