"""Who hears what passes on the line, and what they say to it.

Every byte is every device's to hear. A frame of the host's that nobody disturbed goes to the device whose route it
begins with, in one piece; the others hear it only if they are attentive. What is cut, garbled or glued, everybody
hears byte by byte, unless it holds no byte that any route begins with: then it can move no device out of its ground
state.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from busmaster.emulator.chance import Chance
from busmaster.emulator.collision import Collision
from busmaster.emulator.device import NEVER, Device
from busmaster.emulator.disturbance import misses

Say = Callable[[Device, float, bytes], None]
"""A device is going to say something: from when on, and what."""
TakeBack = Callable[[Device, float], None]
"""A device has restarted at this time: what it was going to say is not said."""


class AttachedDevices:
    """The devices of a line. `say` is called with what they say in answer, `take_back` when one has restarted."""

    def __init__(self, say: Say, take_back: TakeBack, chance: Chance, tau: float) -> None:
        self.devices: list[Device] = []
        self.wakeup = NEVER
        """When a device wants to be woken, at the earliest."""
        self.cut_off: frozenset[Device] = frozenset()
        self._say = say
        self._take_back = take_back
        self._chance = chance
        self._tau = tau
        self._routes: dict[bytes, tuple[Device, ...]] = {}
        self._route_sizes: tuple[int, ...] = ()
        self._openers: frozenset[int] = frozenset()
        self._attentive: dict[Device, None] = {}

    def add(self, device: Device) -> None:
        """Attach a device, which then keeps the line's time and its chance."""
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
        """Take a frame of the host's that passed undisturbed from `start` to `end`."""
        for size in self._route_sizes:
            routed = self._routes.get(frame[:size])
            if routed is not None:
                break
        else:
            self.overhear(frame, start, end, None, whole=False)
            return
        left: list[Device] = []
        # Asked while it waits for something too, as a Mentor II drive does after a read: else all hear byte by byte.
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
        """Take bytes that passed and are no request in one piece.

        With `whole` they are a reply in one piece, which begins with no route.
        """
        if whole or self._openers.isdisjoint(data):
            if not self._attentive:
                return
            listeners: Iterable[Device] = tuple(self._attentive)
        else:
            listeners = self.devices
        self.hear([device for device in listeners if device is not talker], data, start, end)

    def scatter(self, collision: Collision, end: float) -> None:
        """Let each device hear what several talkers made of each other's bytes, but for what fell in its own talk."""
        for device in self.devices:
            for start, byte in collision.heard(device):
                self.hear((device,), bytes((byte,)), start, end)

    def wake(self) -> None:
        """Wake the devices whose time has come, now that `wakeup` has."""
        now = self.wakeup
        self.wakeup = NEVER
        for device in self.devices:
            if device.wakeup <= now:
                device.wake(now)
                self._note(device, now)
            elif device.wakeup < self.wakeup:
                self.wakeup = device.wakeup

    def restart(self, device: Device, now: float) -> None:
        """Restart a device at `now`, and note what it says and when it wants to be woken."""
        device.restart(now)
        self._note(device, now)

    def hear(self, listeners: Iterable[Device], data: bytes, start: float, now: float) -> None:
        """Let `listeners` hear `data` byte by byte; its last byte ended at `now`."""
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
        """Note what it has come to say, whether it must hear everything from now on, and when it wants to be woken."""
        if device.restarted:
            device.restarted = False
            self._take_back(device, now)
        if device.outbox:
            said = device.outbox[:]
            device.outbox.clear()
            if now >= device.away_until and not device.faults.dead:
                for start, data in said:
                    self._say(device, max(start, now), data)
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
