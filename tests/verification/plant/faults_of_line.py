"""What happens to the port, the wire and the drives."""

from __future__ import annotations

import signal
import time

from tests.verification.plant.plant import Plant, Site
from tests.verification.plant.trial import Fault


def port_gone(plant: Plant) -> None:
    plant.order("gone")
    plant.run.heard("the line is down", plant.fault_at)
    plant.order("back")
    plant.over()
    plant.run.heard("the line is up", plant.fault_at)


def drives_killed(plant: Plant) -> None:
    plant.kill_drives()
    plant.run.heard("the line is down", plant.fault_at)
    plant.start_drives()
    plant.over()
    plant.run.heard("the line is up", plant.fault_at)


def still_for(seconds: float) -> Fault:
    def make(plant: Plant) -> None:
        plant.drives.stop()
        time.sleep(seconds)  # this is what is tried
        plant.drives.go_on()
        plant.over()

    return Fault(name=f"all drives are stopped for {seconds:g} s", make=make)


def node_off(plant: Plant) -> None:
    plant.order(f"off {plant.nodes[-1]}")
    plant.run.heard(f"{plant.nodes[-1]} is down", plant.fault_at)
    plant.order("on")
    plant.over()
    plant.run.heard(f"{plant.nodes[-1]} is up", plant.fault_at)


def node_garbles(plant: Plant) -> None:
    plant.order(f"garble {plant.nodes[-1]}")
    plant.run.heard(f"{plant.nodes[-1]} is down", plant.fault_at)
    plant.order("calm")
    plant.over()
    plant.run.heard(f"{plant.nodes[-1]} is up", plant.fault_at)


def noise(plant: Plant) -> None:
    plant.order("babble unwinder")
    count = len(plant.run.printed())
    plant.wait_for_cycles(50, count)
    plant.order("calm")
    plant.over()


def missing_at_start(plant: Plant) -> None:
    plant.start_run()
    plant.run.heard("cannot connect")
    plant.start_drives()
    plant.over()
    plant.run.heard("the line is up", plant.fault_at)


def another_master(plant: Plant) -> str:
    """It uses the same serial server, and knows nothing of us: each hears what the other is told."""
    stranger = {"XDG_RUNTIME_DIR": str(plant.folder)}  # where no line is found, else it would ask through ours
    ask = ("poll", plant.port, "--protocol", "hcp2", "--nodes", "1-3", "--items", "1", "--period", "0.05")
    other = plant.beside(*ask, environment=stranger)
    plant.wait_for_cycles(50, len(plant.run.printed()))
    other.send(signal.SIGTERM)
    other.wait()
    plant.over()
    return f"the other master received {len(other.printed())} values; replies cannot be attributed"


def same_port(plant: Plant) -> str:
    other = plant.once("run", str(plant.file))
    assert other.returncode, other
    plant.over()
    why = other.stderr.splitlines()[-1].removeprefix("busmaster: ")
    return f"the other process: exit status {other.returncode}, `{why}`"


def all_nodes_off(plant: Plant) -> None:
    for node in plant.nodes:
        plant.order(f"off {node}")
    for node in plant.nodes:
        plant.run.heard(f"{node} is down", plant.fault_at)
    plant.order("on")
    plant.over()
    for node in plant.nodes:
        plant.run.heard(f"{node} is up", plant.fault_at)


FAULTS = {
    "port-gone": Fault(name="the port disappears and returns", make=port_gone),
    "server-gone": Fault(
        name="the serial server closes the connection, then refuses new ones", make=port_gone, site=Site(tcp=True)
    ),
    "drives-killed": Fault(name="the process behind the port is killed and restarted", make=drives_killed),
    "still-1": still_for(1.0),
    "still-10": still_for(10.0),
    "node-off": Fault(name="one node is switched off and on", make=node_off),
    "nodes-off": Fault(name="all nodes are switched off and on", make=all_nodes_off),
    "node-garbles": Fault(name="one node's replies have a flipped bit", make=node_garbles),
    "noise": Fault(name="one node sends bursts of noise", make=noise),
    "port-missing": Fault(name="the port is missing at startup", make=missing_at_start, site=Site(starts=False)),
    "same-port": Fault(name="another busmaster is started on the same port", make=same_port),
    "another-master": Fault(
        name="another master uses the same serial server", make=another_master, site=Site(tcp=True), beyond=True
    ),
}
