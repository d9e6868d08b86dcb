// The page: it receives changes by a WebSocket, and draws at most once per frame.

import { Line, milliseconds, shown } from "./line.js";
import { PointDialog } from "./dialog.js";
import { element } from "./element.js";
import { Wire } from "./wire.js";
import { draw_trend } from "./trend.js";

const MOST_SHOWN = 1000;
const AGAIN = 1000; // milliseconds before it is tried again to connect
const FIRST_WAIT = 2000; // milliseconds in which the first picture of the line may be incomplete
const WIRE_EVERY = 50, VALUES_EVERY = 150; // milliseconds from one drawing to the next
const OUT_OF_SIGHT_EVERY = 1000; // milliseconds: rows that are scrolled away are kept up to date for a search of the page
const LONG_TEXT = 14; // characters of a text that fit beside unit and trend
const by = (id) => document.getElementById(id);
const line = new Line();
const wire = new Wire(by("wire-canvas"), by("tip"), by("wire-text"));
const shown_rows = new Map();
let may = { read_only: true, wants_token: false, history: false };
let asked_what_may_be = false; // until then it is not known whether the page is read-only
let connected = false;
let stale = true; // something was received since it was drawn
let known = false; // the first picture of the line was complete
let wire_in_sight = true;
let wire_drawn = -WIRE_EVERY, values_drawn = -VALUES_EVERY, all_drawn = 0; // when, in milliseconds
let order = "";

function colours() {
  const style = getComputedStyle(document.documentElement);
  const of = (name) => style.getPropertyValue(`--${name}`).trim();
  return { ink: of("ok"), dim: of("dim"), bad: of("bad"), late: of("late"), rule: of("rule") };
}

const dialog = new PointDialog(colours);

// received messages

function connect() {
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/stream`);
  const look = () => { if (socket.readyState === 1) socket.send(`{"exchanges":${!document.hidden}}`); };
  socket.onopen = () => { connected = true; stale = true; look(); };
  document.addEventListener("visibilitychange", look);
  socket.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.method === "exchanges") wire.take(message.body);
    else line.take(message);
    if (message.method === "state") { ask_what_may_be(); wire.clear(); }
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
    asked_what_may_be = true;
    stale = true;
  } catch { /* the interface has gone: requested again when it is back */ }
}

function allowed() {
  return { ...may, read_only: may.read_only || Boolean(line.frame?.read_only) };
}

// what is drawn

function is_complete() {
  const { frame } = line;
  return Boolean(frame) && asked_what_may_be && line.rows.length >= frame.points && line.all_nodes.length >= frame.nodes && line.all_groups.length >= frame.groups;
}

// Nothing is shown of a picture that is still arriving: each part of it would move the parts below.
function may_show() {
  if (!known && (is_complete() || performance.now() > FIRST_WAIT)) {
    known = true;
    document.documentElement.dataset.known = "";
  }
  return known;
}

function trouble() {
  if (!connected) return "The program of this page does not reply: the values are old. Reconnecting.";
  if (!line.state.connected) return `The line's program is away: the values are old. ${line.state.why}`;
  if (line.frame?.state === "offline") return `The line is lost: nothing is read or written until its port is back. ${line.frame.why ?? ""}`;
  return "";
}

function draw_head(wrong) {
  const { frame } = line;
  const state = !known ? "connecting" : !connected ? "no connection" : !line.state.connected ? "owner away" : frame?.state ?? "waiting";
  by("state").textContent = { connecting: "connecting", ready: "● ready", resynchronising: "◐ resynchronising", offline: "✕ offline" }[state] ?? `✕ ${state}`;
  by("state").className = `chip ${state === "ready" ? "good" : state === "resynchronising" ? "warn" : "bad"}`;
  by("trouble").hidden = !wrong;
  if (by("trouble").textContent !== wrong) by("trouble").textContent = wrong;
  document.documentElement.dataset.state = state;
  by("mode").textContent = asked_what_may_be && allowed().read_only ? "read-only" : "";
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

const HEALTH = { offline: "✕ offline", up: "✓ up", suspect: "? suspect", down: "✕ down", suspended: "‖ suspended", unknown: "… no request yet" };

function draw_nodes() {
  // a card is drawn again when its node changes, so the loss of line or owner is a change of the node
  const nodes = is_lost() ? line.all_nodes.map((node) => ({ ...node, health: "offline" })) : line.all_nodes;
  replace(by("node-list"), nodes, (item, node) => {
    const { health } = node;
    item.className = health;
    const late = node.late ? `, ${node.late} late` : "";
    item.replaceChildren(element("b", `${node.label}: ${HEALTH[health] ?? health}`),
      element("small", `${node.requests} requests, ${node.failed} failed${late}, p50 ${milliseconds(node.p50)}`));
  }, "li");
}

function in_ms(seconds, digits) {
  return (seconds * 1000).toFixed(digits);
}

function draw_groups() {
  // Two rows a group: beside its name there is no room for the numbers.
  replace(by("group-rows"), line.all_groups.flatMap((group) => [group.name, group]), (row, group) => {
    if (typeof group === "string") {
      const name = element("th", group);
      Object.assign(name, { colSpan: 4, scope: "colgroup" });
      row.replaceChildren(name);
      return;
    }
    const numbers = [in_ms(group.period, 0), group.paused ? "paused" : in_ms(group.achieved, 1), in_ms(group.jitter, 2), `${group.missed} of ${group.cycles}`];
    row.replaceChildren(...numbers.map((text) => element("td", text, "number")));
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
      before.delete(id);
      cells.reason.remove();
      shown_rows.set(id, cells);
      return cells.row;
    });
    for (const { row } of before.values()) in_sight.unobserve(row);
    by("point-rows").replaceChildren(...made);
  }
  const ink = colours(), ages = new Map(line.all_groups.map((group) => [group.name, group.old_after]));
  const lost = is_lost(), may_write = !allowed().read_only, now = performance.now();
  const all_due = now - all_drawn > OUT_OF_SIGHT_EVERY;
  if (all_due) all_drawn = now;
  const to_draw = [];
  for (const row of rows) {
    const cells = shown_rows.get(row.place + row.name);
    if (!cells.in_sight && cells.fact && !all_due) continue;
    fill_row(cells, row, ages, lost, may_write);
    if (cells.in_sight) to_draw.push(cells);
  }
  show_reasons(rows, lost);
  for (const cells of to_draw) draw_row_trend(cells, ink); // after all texts: it needs the width, which the browser calculates only once then
}

// Why points have no value: below the first of those that follow one another and failed alike. The line's own loss is above the page.
function show_reasons(rows, lost) {
  const reason_of = (row) => (lost ? "" : row.error);
  for (let first = 0, next; first < rows.length; first = next) {
    const { node } = rows[first], reason = reason_of(rows[first]);
    for (next = first + 1; next < rows.length && reason && rows[next].node === node && reason_of(rows[next]) === reason; next++);
    const alike = next - first - 1;
    show_reason(rows[first], reason && `✕ ${reason}${alike ? ` (the same for the next ${alike === 1 ? "point" : `${alike} points`})` : ""}`);
    for (let other = first + 1; other < next; other++) show_reason(rows[other], "");
  }
}

function show_reason(row, text) {
  const cells = shown_rows.get(row.place + row.name);
  if (cells.reason_text === text && cells.reason.isConnected === Boolean(text)) return;
  cells.reason_text = text;
  set_text(cells.reason.firstChild, text);
  cells.row.classList.toggle("failed", Boolean(text));
  if (text) cells.row.after(cells.reason);
  else cells.reason.remove();
}

function make_row() {
  const row = element("tr", "", "point"), reason = element("tr", "", "reason");
  const cells = {
    row, reason, reason_text: "", name: element("button", "", "name"), value: element("span"), trend: document.createElement("canvas"),
    write: element("button", "Write"), fact: null, in_sight: false,
  };
  const cell = (kind, content, of = row) => {
    const made = element("td", "", kind);
    made.setAttribute("role", "cell");
    if (content) made.append(content);
    of.append(made);
    return made;
  };
  for (const one of [row, reason]) one.setAttribute("role", "row");
  cell("", null, reason).colSpan = 7;
  cell("point", cells.name);
  cells.value_cell = cell("value", cells.value);
  cells.unit = cell("unit");
  cells.trend_cell = cell("trend", cells.trend);
  cells.age = cell("age");
  cells.quality = cell("quality");
  cell("write", cells.write);
  cells.trend.setAttribute("role", "img");
  cells.trend.setAttribute("aria-label", "trend");
  row.cells_of = cells;
  in_sight.observe(row);
  for (const button of [cells.name, cells.write]) button.addEventListener("click", () => dialog.open(cells.fact, allowed()));
  return cells;
}

function set_text(where, text) {
  if (where.textContent !== text) where.textContent = text;
}

const in_sight = new IntersectionObserver((changes) => {
  for (const { target, isIntersecting } of changes) target.cells_of.in_sight = isIntersecting;
  stale = true;
}, { rootMargin: "50%" });

new IntersectionObserver((changes) => { wire_in_sight = changes.at(-1).isIntersecting; }).observe(by("wire-canvas"));

function age_text(seconds) {
  if (seconds < 1) return "<1 s";
  if (seconds < 100) return `${Math.floor(seconds)} s`;
  return seconds < 6000 ? `${Math.floor(seconds / 60)} min` : `${Math.floor(seconds / 3600)} h`;
}

const ALARMS = { high: "▲ high limit", low: "▼ low limit", set: "▲ bit set", clear: "▼ bit clear" };

function quality_text(row, lost) {
  if (lost || row.error) return "✕ bad";
  return ALARMS[row.alarm] ?? (row.quality || "not read yet");
}

function fill_row(cells, row, ages, lost, may_write) {
  cells.fact = row;
  const age = row.asked === null ? null : Math.max(0, line.now - row.asked);
  const old = age !== null && age > (ages.get(row.group) ?? Infinity);
  const text = shown(row.value, row.precision), long = typeof row.value === "string" && text.length > LONG_TEXT;
  const kind = lost || row.error ? "bad" : row.alarm ? "alarm" : old || row.quality === "stale" ? "old" : "";
  set(cells.row, "className", `point ${kind}${long ? " long" : ""}${cells.reason_text ? " failed" : ""}`);
  const name = `${row.node} ${row.item}`;
  if (cells.name.textContent !== name) {
    cells.name.replaceChildren(...breakable(name));
    cells.name.title = `${row.key}, group ${row.group}`;
    cells.write.setAttribute("aria-label", `Write ${name}`);
  }
  set(cells.value, "className", row.value === null ? "" : "known");
  set(cells.value, "textContent", long ? `${text.replaceAll(",", ", ")} ${row.unit}` : text);
  set(cells.value_cell, "ariaColSpan", long ? "3" : "1"); // a text has no trend
  set(cells.unit, "hidden", long);
  set(cells.trend_cell, "hidden", long);
  set_text(cells.unit, row.unit);
  set_text(cells.age, age === null ? "–" : age_text(age));
  set_text(cells.quality, quality_text(row, lost));
  set(cells.write, "hidden", !row.writable || !may_write);
}

// A name, which a line may end in where its parts do.
function breakable(name) {
  return name.split(/(?<=[_.:/])/).flatMap((part) => [part, document.createElement("wbr")]);
}

// Setting what is there already costs the browser a calculation of the layout, too.
function set(where, property, value) {
  if (where[property] === value) return false;
  where[property] = value;
  return true;
}

function draw_row_trend(cells, ink) {
  const row = cells.fact, last = row.past.at(-1)?.[0];
  if (cells.drawn === last && cells.ink === ink.ink) return;
  cells.drawn = last;
  cells.ink = ink.ink;
  draw_trend(cells.trend, row, ink);
  cells.trend.setAttribute("aria-label", `trend of ${row.past.length} values`);
}

function draw() {
  requestAnimationFrame(draw);
  const now = performance.now();
  if (document.hidden || now - wire_drawn < WIRE_EVERY && now - values_drawn < VALUES_EVERY) return;
  const before = known, show = may_show();
  if (show && !before) values_drawn = -VALUES_EVERY; // all of it in one frame: what came later would move what is there
  if (show && wire_in_sight && now - wire_drawn >= WIRE_EVERY) {
    wire_drawn = now;
    wire.draw(line.all_nodes, line.now, line.state.connected ? line.frame?.state ?? "ready" : "offline");
  }
  if (!stale || now - values_drawn < VALUES_EVERY) return;
  values_drawn = now;
  stale = false;
  draw_head(show ? trouble() : "");
  if (!show) return;
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
setInterval(() => { stale = true; }, 1000); // ages increase while nothing is received

ask_what_may_be();
connect();
draw();
