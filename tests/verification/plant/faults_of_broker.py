"""What happens to the broker, and to the network before it."""

from __future__ import annotations

import signal

from tests.verification.plant.plant import Plant, Site
from tests.verification.plant.trial import Fault

SPILL = Site(mqtt='spill = "{folder}/mqtt.spool"')
ENOUGH = 30
"""Cycles that are polled while the broker is away."""


def kill_broker(plant: Plant) -> None:
    """Kill it when the subscriber has heard all that the broker has acknowledged.

    A client that finds its connection broken does not read what has come on it: the subscriber would count messages as
    lost that `run` may well forget.
    """
    plant.gateway.hold()
    plant.subscriber.catch_up()
    plant.broker.kill()
    plant.gateway.reset()
    plant.gateway.pass_on()


def away(plant: Plant) -> None:
    kill_broker(plant)
    plant.gateway.close()
    plant.run.heard("mqtt is down", plant.fault_at)


def back(plant: Plant) -> None:
    """The broker is there again, and whoever listens to it, before `run` finds it."""
    plant.broker.start()
    plant.subscriber.connect()
    plant.gateway.open()
    plant.over()


def killed(plant: Plant) -> None:
    away(plant)
    plant.wait_for_cycles(ENOUGH)
    back(plant)
    plant.run.heard("mqtt is up again", plant.fault_at)


def stopped(plant: Plant) -> None:
    plant.broker.send(signal.SIGSTOP)
    plant.run.heard("mqtt is down", plant.fault_at)
    plant.broker.send(signal.SIGCONT)
    plant.over()
    plant.run.heard("mqtt is up again", plant.fault_at)


def refuses(plant: Plant) -> None:
    kill_broker(plant)
    plant.broker.start(refusing=True)
    plant.run.heard("uthor", plant.fault_at)  # not authorized, as the broker words it
    plant.gateway.close()
    plant.broker.kill()
    back(plant)
    plant.run.heard("mqtt is up again", plant.fault_at)


def half_open(plant: Plant) -> None:
    plant.gateway.hold()
    plant.run.heard("mqtt is down", plant.fault_at)
    plant.gateway.reset()
    plant.gateway.pass_on()
    plant.over()
    plant.run.heard("mqtt is up again", plant.fault_at)


def broken_off(plant: Plant) -> None:
    plant.gateway.reset()
    plant.run.heard("mqtt is down", plant.fault_at)
    plant.over()
    plant.run.heard("mqtt is up again", plant.fault_at)


def away_at_the_end(plant: Plant) -> str:
    away(plant)
    plant.wait_for_cycles(ENOUGH)
    plant.end_run()
    [kept] = [line for line in plant.run.told if line.startswith("busmaster: mqtt: ")]
    back(plant)
    plant.start_run()
    return f"first run: `{kept.removeprefix('busmaster: ')}`"


def away_for_good(plant: Plant) -> None:
    away(plant)
    plant.wait_for_cycles(ENOUGH)
    plant.end_run()


def damaged_spill(plant: Plant) -> str:
    note = away_at_the_end_of_a_run_before(plant)
    spool = plant.folder / "mqtt.spool"
    with spool.open("r+b") as file:
        file.write(bytes(range(256)) * 16)
    back(plant)
    plant.start_run()
    plant.run.heard("is kept as", plant.fault_at)
    return note


def away_at_the_end_of_a_run_before(plant: Plant) -> str:
    away(plant)
    plant.wait_for_cycles(ENOUGH)
    plant.end_run()
    return "the damaged file is kept under another name; its values are not counted"


FAULTS = {
    "broker-killed": Fault(name="the broker is killed and restarted", make=killed),
    "broker-killed-spill": Fault(name="the same with `spill`", make=killed, site=SPILL),
    "broker-stopped": Fault(name="the broker is stopped, then continues", make=stopped),
    "broker-refuses": Fault(name="the broker rejects all logins, then accepts them", make=refuses),
    "half-open": Fault(name="the network to the broker drops all data (half-open connection)", make=half_open),
    "broken-off": Fault(name="the connection to the broker is reset", make=broken_off),
    "buffer-full": Fault(
        name="the broker is unavailable until `buffer` is full", make=killed, site=Site(mqtt="buffer = 40")
    ),
    "spill-full": Fault(
        name="the broker is unavailable until `spill_values` is reached",
        make=killed,
        site=Site(mqtt='spill = "{folder}/mqtt.spool"\nspill_values = 40'),
    ),
    "away-at-end": Fault(
        name="the broker is unavailable when `run` ends, with `spill`", make=away_at_the_end, site=SPILL
    ),
    "away-for-good": Fault(name="the broker is unavailable when `run` ends, without `spill`", make=away_for_good),
    "spill-damaged": Fault(
        name="the file of `spill` is damaged at startup", make=damaged_spill, site=SPILL, uncounted=("mqtt",)
    ),
}
