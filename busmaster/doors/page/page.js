// The page: it is told what changes by a WebSocket, and draws that at most once a frame.

import { Line, milliseconds, shown } from "./line.js";
import { PointDialog, element } from "./dialog.js";
import { Wire } from "./wire.js";
import { draw_trend } from "./trend.js";

const MOST_SHOWN = 1000;
const OLD_AFTER = 3; // periods after which a value's age is worth a look
const AGAIN = 1000; // milliseconds before it is tried again to connect
const by = (id) => document.getElementById(id);
const line = new Line();
const wire = new Wire(by("wire-canvas"), by("tip"), by("wire-said"));
const shown_rows = new Map();
let may = { read_only: true, wants_token: false };
let connected = false;
let stale = true; // something was heard since it was drawn
let order = "";

function colours() {
  const style = getComputedStyle(document.documentElement);
  const of = (name) => style.getPropertyValue(`--${name}`).trim();
  return { ink: of("ok"), dim: of("dim"), bad: of("bad") };
}

const dialog = new PointDialog(colours);

// what is heard

function connect() {
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/stream`);
  const look = () => { if (socket.readyState === 1) socket.send(`{"exchanges":${!document.hidden}}`); };
  socket.onopen = () => { connected = true; stale = true; look(); };
  document.addEventListener("visibilitychange", look);
  socket.onmessage = ({ data }) => {
    const said = JSON.parse(data);
    if (said.method === "exchanges") wire.hear(said.body);
    else line.hear(said);
    if (said.method === "state") { ask_what_may_be(); wire.clear(); }
    stale = true;
  };
  socket.onclose = () => {
    connected = false;
    stale = true;
    document.removeEventListener("visibilitychange", look);
    setTimeout(connect, AGAIN);
  };
}

async function ask_what_may_be() {
  try {
    may = await (await fetch("/api/line")).json();
    stale = true;
  } catch { /* the door has gone: asked again when it is back */ }
}

function allowed() {
  return { ...may, read_only: may.read_only || Boolean(line.frame?.read_only) };
}

// what is drawn

function trouble() {
  if (!connected) return "This page's program does not answer: what is shown is old. It is tried again.";
  if (!line.state.connected) return `The line's program is away: what is shown is old. ${line.state.why}`;
  if (line.frame?.state === "offline") return `The line is lost: nothing is read or written until its port is back. ${line.frame.why ?? ""}`;
  return "";
}

function draw_head(wrong) {
  const { frame } = line;
  const state = !connected ? "no connection" : !line.state.connected ? "owner away" : frame?.state ?? "waiting";
  by("state").textContent = { ready: "● ready", settling: "◐ settling", offline: "✕ offline" }[state] ?? `✕ ${state}`;
  by("state").className = `chip ${state === "ready" ? "good" : state === "settling" ? "warn" : "bad"}`;
  by("trouble").hidden = !wrong;
  if (by("trouble").textContent !== wrong) by("trouble").textContent = wrong;
  document.documentElement.dataset.state = state;
  by("mode").textContent = allowed().read_only ? "read-only" : "";
  if (!frame) return;
  by("title").textContent = frame.title;
  document.title = `${state === "ready" ? "" : "✕ "}${frame.title}`;
  by("port").textContent = `${frame.line} ${frame.settings}`;
  const down = line.all_nodes.filter((node) => node.health === "down").length;
  const lost = is_lost();
  by("health").textContent = lost ? `✕ ${line.all_nodes.length} nodes offline` : down ? `✕ ${down} of ${line.all_nodes.length} nodes down` : `${line.all_nodes.length} nodes, none down`;
  by("health").className = lost || down ? "bad" : "";
  by("load").value = frame.utilisation;
  by("load-text").textContent = `${(frame.utilisation * 100).toFixed(0)} %`;
  by("waiting").textContent = `${frame.backlog} waiting, lost ${frame.losses} ${frame.losses === 1 ? "time" : "times"}${wire.left_out ? `, ${wire.left_out} exchanges not shown` : ""}`;
}

function is_lost() {
  return !connected || !line.state.connected || line.frame?.state === "offline";
}

const HEALTH = { offline: "✕ offline", up: "✓ up", suspect: "? suspect", down: "✕ down", suspended: "‖ suspended", unknown: "… not asked yet" };

function draw_nodes() {
  replace(by("node-list"), line.all_nodes, (item, node) => {
    const health = is_lost() ? "offline" : node.health;
    item.className = health;
    const late = node.late ? `, ${node.late} late` : "";
    item.replaceChildren(element("b", `${node.label}: ${HEALTH[health] ?? health}`),
      element("small", `${node.requests} asked, ${node.failed} failed${late}, p50 ${milliseconds(node.p50)}`));
  }, "li");
}

function draw_groups() {
  replace(by("group-rows"), line.all_groups, (row, group) => {
    const numbers = [milliseconds(group.period, 0), group.paused ? "paused" : milliseconds(group.achieved), milliseconds(group.jitter, 2), group.cycles, group.missed];
    row.replaceChildren(element("td", group.name), ...numbers.map((text) => element("td", text, "number")));
  }, "tr");
}

function draw_events() {
  const events = [...(line.frame?.events ?? [])].reverse();
  replace(by("event-list"), events, (item, [when, text]) => {
    const at = new Date(Date.now() - (line.now - when) * 1000);
    const time = element("time", at.toLocaleTimeString());
    time.dateTime = at.toISOString();
    item.replaceChildren(time, element("span", text));
  }, "li");
}

// Children are made anew only where what they show is other than before.
function replace(parent, things, fill, tag) {
  while (parent.children.length > things.length) parent.lastElementChild.remove();
  things.forEach((thing, number) => {
    const child = parent.children[number] ?? parent.appendChild(document.createElement(tag));
    const text = JSON.stringify(thing);
    if (child.shows !== text) { child.shows = text; fill(child, thing); }
  });
}

function draw_points() {
  const words = by("find").value.toLowerCase().split(/\s+/).filter(Boolean);
  const all = line.rows;
  const named = (row) => `${row.node} ${row.item} ${row.key} ${row.group} ${row.unit} ${row.error} ${row.alarm}`.toLowerCase();
  const found = words.length ? all.filter((row) => words.every((word) => named(row).includes(word))) : all;
  const rows = found.slice(0, MOST_SHOWN);
  by("found").textContent = found.length === all.length && rows.length === found.length ? `${all.length} points` : `${rows.length} of ${all.length} points`;
  const wanted = rows.map((row) => row.place + row.name).join("\n");
  if (wanted !== order) {
    order = wanted;
    const before = new Map(shown_rows);
    shown_rows.clear();
    const made = rows.map((row) => {
      const id = row.place + row.name;
      const cells = before.get(id) ?? make_row();
      shown_rows.set(id, cells);
      return cells.row;
    });
    by("point-rows").replaceChildren(...made);
  }
  const ink = colours(), periods = new Map(line.all_groups.map((group) => [group.name, group.period]));
  for (const row of rows) fill_row(shown_rows.get(row.place + row.name), row, ink, periods);
}

function make_row() {
  const row = document.createElement("tr");
  const cells = { row, name: element("button", "", "name"), write: element("button", "Write"), trend: document.createElement("canvas"), fact: null };
  const cell = (kind, content) => { const made = element("td", "", kind); if (content) made.append(content); row.append(made); return made; };
  cell("", cells.name);
  cells.value = cell("value");
  cells.unit = cell("unit");
  cell("", cells.trend);
  cells.age = cell("age");
  cells.remark = cell("remark");
  cells.last = cell("", cells.write);
  cells.trend.setAttribute("role", "img");
  for (const button of [cells.name, cells.write]) button.addEventListener("click", () => dialog.open(cells.fact, allowed()));
  return cells;
}

function set_text(where, text) {
  if (where.textContent !== text) where.textContent = text;
}

function fill_row(cells, row, ink, periods) {
  cells.fact = row;
  const age = row.asked === null ? null : Math.max(0, line.now - row.asked);
  const old = age !== null && age > OLD_AFTER * (periods.get(row.group) ?? 1) + 0.5;
  cells.row.className = row.error ? "bad" : row.alarm ? "alarm" : old ? "old" : "";
  set_text(cells.name, `${row.node} ${row.item}`);
  cells.name.title = `${row.key}, group ${row.group}`;
  set_text(cells.value, shown(row.value, row.precision));
  set_text(cells.unit, row.unit);
  set_text(cells.age, age === null ? "" : old ? `${age.toFixed(age < 10 ? 1 : 0)} s` : "");
  const qualities = { late: "came late", stale: "older than a write" };
  set_text(cells.remark, row.error ? `✕ ${row.error}` : row.alarm ? `▲ ${row.alarm} limit` : qualities[row.quality] ?? "");
  cells.write.hidden = !row.writable || allowed().read_only;
  const last = row.past.at(-1)?.[0];
  if (cells.drawn !== last || cells.ink !== ink.ink) {
    cells.drawn = last;
    cells.ink = ink.ink;
    draw_trend(cells.trend, row, ink);
    cells.trend.setAttribute("aria-label", `trend of ${row.past.length} values`);
  }
}

function draw() {
  requestAnimationFrame(draw);
  if (document.hidden) return;
  wire.draw(line.all_nodes, line.now, line.state.connected ? line.frame?.state ?? "ready" : "offline");
  if (!stale) return;
  stale = false;
  draw_head(trouble());
  draw_nodes();
  draw_groups();
  draw_events();
  draw_points();
  dialog.allow(allowed());
  dialog.draw(line);
}

// what a person does

function hold() {
  const held = wire.hold(line.now);
  by("hold").setAttribute("aria-pressed", held);
  by("hold").textContent = held ? "Go on" : "Hold";
}

by("hold").addEventListener("click", hold);
by("wire-canvas").addEventListener("hold", hold);
by("span").addEventListener("change", ({ target }) => { wire.span = Number(target.value); });
by("find").addEventListener("input", () => { stale = true; });
addEventListener("resize", () => { for (const cells of shown_rows.values()) cells.drawn = null; stale = true; });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { stale = true; });
setInterval(() => { stale = true; }, 1000); // ages go on while nothing is heard

ask_what_may_be();
connect();
draw();
