"""A program without asyncio: the bus runs in a thread of its own, and other threads call it and wait.

    python examples/from_a_thread.py [PORT]    such as /dev/ttyUSB0; without one, emulated

With a PORT it writes Comms(1) of node 5.
"""

import sys
from concurrent.futures import ThreadPoolExecutor

from anyio.from_thread import BlockingPortal, start_blocking_portal

from busmaster import Bus, BusLike, Endpoint, Hcp2Controller, MemoryPort, endpoint
from busmaster.emulator.line import Line
from busmaster.registry import make_device

SETTINGS = Hcp2Controller.profile.line


def main(portal: BlockingPortal, bus: BusLike) -> None:
    controller = portal.call(Hcp2Controller, bus, 5)
    portal.call(controller.write, 1, 12.5)
    print("Comms(1) is", portal.call(controller.read, 1))
    print("adc0 to adc3 are", in_parallel(portal, controller))


def in_parallel(portal: BlockingPortal, controller: Hcp2Controller) -> list[float]:
    """Several threads can send requests at once: the bus sends them one after another."""
    with ThreadPoolExecutor() as threads:
        return list(threads.map(lambda channel: portal.call(controller.io.adc(channel).read), range(4)))


def emulated() -> MemoryPort:
    return MemoryPort(Line(SETTINGS, [make_device("hcp2", 5)]))


def on_port(port: Endpoint) -> None:
    with start_blocking_portal() as portal, portal.wrap_async_context_manager(Bus(port)) as bus:
        main(portal, bus)


if __name__ == "__main__":
    on_port(endpoint(sys.argv[1], defaults=SETTINGS) if sys.argv[1:] else emulated())
