"""What comes in by MQTT that should not, or not so."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from functools import partial
from statistics import median

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

from tests.patience import PATIENCE
from tests.verification.plant.brokers import PREFIX
from tests.verification.plant.plant import SETPOINT, Plant
from tests.verification.plant.programs import until
from tests.verification.plant.trial import Fault

FLOOD = 70_000
UNDER_WAY = 1_000
"""Of them, how many are on their way at a time."""
LATE = 1.5
"""Seconds for which commands wait that are meant for one."""


def refusal(plant: Plant, payload: str | bytes, topic: str = "") -> str:
    """Send it, and return why it was refused."""
    since = time.monotonic()
    plant.subscriber.send(SETPOINT, payload, topic=topic)
    until(lambda: bool(plant.subscriber.since(since, "result")), "it is answered")
    answer = plant.subscriber.since(since, "result")[0].payload
    assert answer["ok"] is False, answer
    return str(answer["error"])


def strange(make: Callable[[], str | bytes], topic: str = "") -> Callable[[Plant], str]:
    def made(plant: Plant) -> str:
        why = refusal(plant, make(), topic)
        plant.over()
        plant.obeys_commands()
        return f"rejected: `{why[:120]}`"

    return made


def pour(plant: Plant, sent: threading.Event) -> None:
    """Send a flood of commands that are refused."""
    client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5)
    client.connect("127.0.0.1", plant.broker.port)
    client.loop_start()
    try:
        for number in range(FLOOD):
            last = client.publish(f"{PREFIX}/set/nobody/1", str(number), qos=1)
            if number % UNDER_WAY == UNDER_WAY - 1:
                last.wait_for_publish(PATIENCE)
    finally:
        sent.set()
        client.disconnect()
        client.loop_stop()


def poured(plant: Plant) -> None:
    pour(plant, threading.Event())
    plant.over()


def flood(plant: Plant) -> str:
    sent = threading.Event()
    thread = threading.Thread(target=pour, args=(plant, sent), daemon=True)
    thread.start()
    took: list[float] = []
    done = 0
    while not sent.is_set():
        asked = time.monotonic()
        answer = plant.command(f"in the flood {len(took)}", len(took) % 400)
        took.append(time.monotonic() - asked)
        done += bool(answer["ok"])
    thread.join()
    plant.over()
    return (
        f"{done} of {len(took)} allowed commands carried out, the others refused; results within {max(took):.1f} s,"
        f" half of them within {median(took):.1f} s"
    )


def late(plant: Plant) -> str:
    plant.run.stop()
    for number in range(5):
        plant.subscriber.send(SETPOINT, json.dumps({"value": 100 + number, "id": f"late {number}"}))
    plant.subscriber.send(SETPOINT, json.dumps({"value": 111, "id": "expired", "expires": time.time() + 0.5}))
    time.sleep(LATE)  # this is what is tried
    plant.run.go_on()
    plant.over()
    answers = [plant.subscriber.answer(f"late {number}") for number in range(5)] + [plant.subscriber.answer("expired")]
    assert not any(answer["ok"] for answer in answers), answers
    plant.obeys_commands()
    return f"each rejected: `{answers[0]['error']}`"


def beyond_a_limit(plant: Plant) -> str:
    answer = plant.command("too much", 501)
    assert not answer["ok"]
    plant.over()
    plant.obeys_commands()
    return f"rejected: `{answer['error']}`"


def while_the_line_is_gone(plant: Plant) -> str:
    plant.order("gone")
    plant.run.heard("the line is down", plant.fault_at)
    answer = plant.command("nowhere")
    assert not answer["ok"]
    plant.order("back")
    plant.over()
    plant.run.heard("the line is up", plant.fault_at)
    plant.obeys_commands()
    return f"rejected: `{answer['error']}`"


def to_a_dead_node(plant: Plant) -> str:
    plant.order("off winder")
    plant.run.heard("winder is down", plant.fault_at)
    answer = plant.command("to the dead")
    assert not answer["ok"]
    plant.order("on")
    plant.over()
    plant.run.heard("winder is up", plant.fault_at)
    plant.obeys_commands()
    return f"rejected: `{answer['error']}`"


def forbidden(plant: Plant) -> str:
    why = refusal(plant, "1", f"{PREFIX}/set/winder/11")
    plant.over()
    return f"rejected: `{why}`"


LONG_TOPIC = f"{PREFIX}/set/{'x' * 65_000}"
FAULTS = {
    "huge-payload": Fault(name="a command of 1 MB", make=strange(partial(bytes, 1_000_000))),
    "1e308": Fault(name="a command of 1e308", make=strange(lambda: "1e308")),
    "nested": Fault(name="a command nested 100,000 deep", make=strange(lambda: "[" * 100_000)),
    "nested-4k": Fault(name="a command nested 4,000 deep", make=strange(lambda: "[" * 2_000 + "]" * 2_000)),
    "long-topic": Fault(name="a topic of 64 kB", make=strange(lambda: "1", LONG_TOPIC)),
    "flood": Fault(name="70,000 refused commands", make=flood),
    "late-commands": Fault(name="`run` is stopped while commands arrive", make=late),
    "limit": Fault(name="a command beyond a limit", make=beyond_a_limit),
    "forbidden": Fault(name="a command that the file does not allow", make=forbidden),
    "command-no-line": Fault(name="a command while the port is missing", make=while_the_line_is_gone),
    "command-no-node": Fault(name="a command to a node that is switched off", make=to_a_dead_node),
}
