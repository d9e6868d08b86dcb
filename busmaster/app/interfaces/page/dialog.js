// One point: its details, and the form that writes it after a confirmation.

import { element } from "./element.js";
import { shown } from "./line.js";
import { Plot } from "./plot.js";

const LONG_TEXT = 40; // characters that are shown in large letters
const by = (id) => document.getElementById(id);
const box = by("point"), form = by("write-form"), field = by("new-value");

export class PointDialog {
  constructor(colours) {
    this.colours = colours;
    this.plot = new Plot();
    this.row = null;
    this.asked = null; // the value that is to be confirmed
    this.details = null;
    this.busy = false;
    by("shut").addEventListener("click", () => box.close());
    by("back").addEventListener("click", () => { this.ask(null); field.focus(); });
    box.addEventListener("close", () => { this.row = null; this.plot.close(); });
    field.addEventListener("input", () => { this.ask(null); this.outcome(""); });
    form.addEventListener("submit", (event) => { event.preventDefault(); this.submit(); });
  }

  async open(row, may) {
    Object.assign(this, { row, details: null, allowed: "" });
    by("point-name").textContent = `${row.node} ${row.item} (${row.key})`;
    by("point-unit").textContent = by("new-unit").textContent = row.unit;
    field.value = "";
    this.outcome("");
    by("write-limits").textContent = "";
    by("point-facts").replaceChildren();
    this.allow(may);
    box.showModal();
    this.plot.open(row, may.history ? path_of(row, "history") : null);
    this.draw();
    (by("go").hidden ? by("shut") : field).focus();
    await this.load(row);
  }

  // Called whenever something else may be allowed: who could write this may not be let through any more.
  allow(may) {
    if (!this.row) return;
    const why = why_not(this.row, may), allowed = JSON.stringify([why, may.wants_token]);
    if (allowed === this.allowed) return;
    this.allowed = allowed;
    form.querySelectorAll("p:not(#outcome)").forEach((line) => { line.hidden = Boolean(why); });
    by("go").hidden = Boolean(why);
    by("token-line").hidden = Boolean(why) || !may.wants_token;
    by("no-write").textContent = why;
    by("no-write").hidden = !why;
    this.ask(null);
  }

  async load(row) {
    let answer;
    try {
      answer = await (await fetch(path_of(row))).json();
    } catch {
      return;
    }
    if (this.row !== row || !answer.details) return;
    this.details = answer.details;
    by("write-limits").textContent = limits_text(answer.details, row.unit);
    field.inputMode = Object.keys(answer.details.labels ?? {}).length ? "text" : "decimal";
    this.draw();
  }

  // Called whenever there may be another value.
  draw(line) {
    const row = this.row && line ? line.rows.find((one) => one.name === this.row.name) : this.row;
    if (!row || !box.open && line) return;
    this.row = row;
    const reading = shown(row.value, row.precision);
    by("point-value").textContent = reading;
    by("point-reading").classList.toggle("long", reading.length > LONG_TEXT);
    this.plot.bounds = [this.details?.low, this.details?.high].filter((bound) => typeof bound === "number");
    this.plot.colours = this.colours();
    this.plot.update(row, line);
    const facts = [["group", row.group], ["protocol", `${row.kind}, address ${row.address}`]];
    if (this.details) facts.push(["command", this.details.command]);
    if (this.details && (this.details.low !== null || this.details.high !== null)) facts.push(["alarms", alarms_text(this.details, row)]);
    if (row.error) facts.push(["last cycle", row.error + (this.details?.hint ? `; ${this.details.hint}` : "")]);
    const text = JSON.stringify(facts);
    if (text === this.shown) return;
    this.shown = text;
    by("point-facts").replaceChildren(...facts.flatMap(([name, text]) => [element("dt", name), element("dd", text)]));
  }

  ask(value) {
    this.asked = value;
    const ask = by("ask");
    ask.hidden = by("back").hidden = value === null;
    field.readOnly = value !== null;
    if (value !== null) ask.textContent = `Write ${value} ${this.row.unit} to ${this.row.node} ${this.row.item}? It is ${shown(this.row.value, this.row.precision)} ${this.row.unit} now.`;
    by("go").textContent = value === null ? "Write…" : `Write ${value} ${this.row.unit}`.trim();
  }

  outcome(text, kind = "") {
    by("outcome").textContent = text;
    by("outcome").className = kind;
  }

  async submit() {
    if (!this.row || this.busy || by("go").hidden) return;
    const value = typed(field.value);
    if (value === null) return this.outcome("Enter a value.", "bad");
    if (this.asked === null) {
      const wrong = beyond(value, this.details);
      if (wrong) return this.outcome(wrong, "bad");
      return this.ask(value);
    }
    await this.write(this.row, this.asked);
  }

  async write(row, value) {
    this.busy = by("go").disabled = true;
    this.outcome("being written");
    const headers = { "Content-Type": "application/json" };
    if (by("token").value) headers.Authorization = `Bearer ${by("token").value}`;
    try {
      const answer = await fetch(path_of(row), { method: "PUT", headers, body: JSON.stringify({ value }) });
      const result = await answer.json();
      this.outcome(answer.ok ? `${value} ${row.unit} was written.` : result.what, answer.ok ? "good" : "bad");
    } catch {
      this.outcome("The program of this page did not reply: the write may have been sent. Read the value before you write again.", "bad");
    } finally {
      this.busy = by("go").disabled = false;
      if (this.row) this.ask(null);
    }
  }
}

function why_not(row, may) {
  if (!row.writable) return "This point is read-only.";
  if (may.read_only) return "This page is read-only: nothing can be written here.";
  return "";
}

function path_of(row, what = "points") {
  return `/api/${what}/${encodeURIComponent(row.group)}/${row.key.split("/").map(encodeURIComponent).join("/")}`;
}

function typed(text) {
  const entry = text.trim();
  if (!entry) return null;
  return /^[-+]?(\d+[.,]?\d*|[.,]\d+)(e[-+]?\d+)?$/i.test(entry) ? Number(entry.replace(",", ".")) : entry;
}

// Numbers have limits. What is shown as a text and has a limit all the same is a bit.
function alarms_text({ low, high }, row) {
  if (typeof row.value === "string") return high === null ? "while it is clear" : "while it is set";
  return `below ${bound(low)}, above ${bound(high)}`;
}

function bound(value) {
  return value === null || value === undefined ? "–" : value;
}

function limits_text(details, unit) {
  const labels = Object.values(details.labels ?? {});
  const names = labels.length ? `Values: ${labels.join(", ")}. ` : "";
  return names + details.limits.map((limit) => {
    const parts = [];
    if (!limit.writable) parts.push("not to be written");
    if (limit.minimum !== null) parts.push(`at least ${limit.minimum} ${unit}`);
    if (limit.maximum !== null) parts.push(`at most ${limit.maximum} ${unit}`);
    if (limit.max_step !== null) parts.push(`at most ${limit.max_step} ${unit} a step`);
    return parts.join(", ");
  }).filter(Boolean).map((text) => `Limits: ${text}.`).join(" ");
}

// The line refuses it all the same; here the user is told before anything is sent.
function beyond(value, details) {
  for (const limit of details?.limits ?? []) {
    if (!limit.writable) return "The line's file does not permit writes to this point.";
    if (typeof value !== "number") continue;
    if (limit.minimum !== null && value < limit.minimum) return `${value} is below the limit of ${limit.minimum}.`;
    if (limit.maximum !== null && value > limit.maximum) return `${value} is above the limit of ${limit.maximum}.`;
  }
  return "";
}
