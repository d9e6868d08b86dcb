// The plot of a point's past: the last values that the page has, and of /api/history what lies before them.
// Wheel, buttons and keys zoom and move it; while its end is now, it moves on by itself.

import { shown } from "./line.js";
import { fit } from "./trend.js";

const LEFT = 54, RIGHT = 8, TOP = 8, BOTTOM = 22; // pixels around the plot, for the ticks
const SHORTEST = 0.5, LONGEST = 10 * 366 * 86400; // seconds
const MOST_PARTS = 1000;
const QUIET = 150; // milliseconds without a move before history is requested
const OFTENEST = 2, RAREST = 60; // seconds between requests while the plot moves on
const ZOOM = 1.5, STEP = 0.25;
const TIMES = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200, 86400, 172800, 604800, 2592000, 7776000, 31536000];
const by = (id) => document.getElementById(id);

export class Plot {
  constructor() {
    this.canvas = by("plot-canvas");
    this.note = by("plot-note");
    this.span_list = by("plot-span");
    this.offset = 0; // from the line's clock to seconds since 1970
    this.close();
    const { canvas } = this, click = (id, act) => by(id).addEventListener("click", act);
    this.span_list.addEventListener("change", () => this.choose());
    click("plot-earlier", () => this.move(-STEP));
    click("plot-later", () => this.move(STEP));
    click("plot-in", () => this.zoom(1 / ZOOM));
    click("plot-out", () => this.zoom(ZOOM));
    click("plot-now", () => this.go(this.now() - this.span, this.now()));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(event.deltaY < 0 ? 1 / ZOOM : ZOOM, this.fraction(event));
    }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.held = { at: event.clientX, begin: this.begin, end: this.end };
    });
    canvas.addEventListener("pointermove", (event) => (this.held ? this.drag(event) : this.point_at(this.fraction(event))));
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { this.held = null; });
    canvas.addEventListener("pointerleave", () => this.point_at(null));
    canvas.addEventListener("keydown", (event) => {
      const act = { ArrowLeft: () => this.move(-STEP), ArrowRight: () => this.move(STEP), "+": () => this.zoom(1 / ZOOM), "-": () => this.zoom(ZOOM), End: () => this.go(this.now() - this.span, this.now()) }[event.key];
      if (act) { event.preventDefault(); act(); }
    });
  }

  // Show another point. `path` is where its history is, null if there is none.
  open(row, path) {
    this.close();
    Object.assign(this, { row, path });
    this.span_list.value = path === null ? "60" : "3600";
    this.choose();
  }

  close() {
    clearTimeout(this.timer);
    Object.assign(this, { row: null, path: null, begin: 0, end: 1, live: true, held: null, at: null, seen: "", failed: "", loaded: null, requested: (this.requested ?? 0) + 1, asked: 0, loading: 0, bounds: [] });
  }

  get span() { return this.end - this.begin; }
  now() { return Date.now() / 1000; }

  choose() {
    const span = Number(this.span_list.value);
    if (span) this.go(this.now() - span, this.now());
  }

  go(begin, end) {
    const now = this.now(), span = Math.min(Math.max(end - begin, SHORTEST), LONGEST);
    const until = Math.min(end - (end - begin - span) / 2, now);
    Object.assign(this, { begin: until - span, end: until, live: until > now - span / 50 - 0.05, asked: now });
    const named = [...this.span_list.options].find(({ value }) => value && Math.abs(Number(value) - span) < 0.01 * span);
    this.span_list.value = named ? named.value : "";
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.load(), QUIET);
    this.draw();
  }

  move(share) { this.go(this.begin + share * this.span, this.end + share * this.span); }

  // `at` is the part of the width that stays in its place; of a plot that moves on, its end.
  zoom(factor, at = this.live ? 1 : 0.5) {
    const fixed = this.begin + at * this.span;
    this.go(fixed - at * this.span * factor, fixed + (1 - at) * this.span * factor);
  }

  drag({ clientX }) {
    const { at, begin, end } = this.held, by = ((at - clientX) / (this.canvas.clientWidth - LEFT - RIGHT)) * (end - begin);
    this.go(begin + by, end + by);
  }

  fraction({ clientX }) {
    const { left } = this.canvas.getBoundingClientRect();
    return Math.min(Math.max((clientX - left - LEFT) / (this.canvas.clientWidth - LEFT - RIGHT), 0), 1);
  }

  point_at(fraction) {
    this.at = fraction;
    this.draw();
  }

  async load() {
    const { path } = this, number = ++this.requested;
    if (path === null) return;
    this.asked = this.now();
    this.loading = number;
    const limit = Math.min(Math.max(Math.round(this.canvas.clientWidth), 100), MOST_PARTS);
    let answer, ok = false;
    try {
      const reply = await fetch(`${path}?from=${this.begin}&to=${this.end}&limit=${limit}`);
      answer = await reply.json();
      ok = reply.ok;
    } catch {
      answer = { what: "The program of this page did not reply." };
    }
    if (number === this.loading) this.loading = 0;
    if (number !== this.requested) return; // the plot has moved, or shows another point
    this.failed = ok ? "" : answer.what;
    if (ok) this.loaded = answer;
    this.draw();
  }

  // Called with each change of the line: `row` has its last values, which the database does not have yet.
  update(row, line) {
    if (!this.row) return;
    this.row = row;
    if (line?.state.connected && line.frame) this.offset = this.now() - line.now;
    if (this.live && !this.held) {
      const { span } = this;
      this.end = this.now();
      this.begin = this.end - span;
      if (!this.loading && this.end - this.asked > Math.min(Math.max(span / 100, OFTENEST), RAREST)) this.load();
    }
    this.draw();
  }

  // What is drawn: [begin, end, lowest, highest, errors, samples], in the order of time. A sample is a part of one.
  parts() {
    const { loaded } = this, number = (value) => (typeof value === "number" ? value : null);
    const parts = !loaded ? [] : loaded.parts.length
      ? loaded.parts.map(({ begin, end, lowest, highest, errors, samples }) => [begin, end, number(lowest), number(highest), errors, samples])
      : loaded.samples.map(({ time, value, error }) => [time, time, number(value), number(value), error === null ? 0 : 1, 1]);
    const last = parts.at(-1)?.[1] ?? -Infinity;
    const text = typeof this.row.value === "string";
    for (const [when, value] of this.row.past) {
      const time = when + this.offset;
      if (time > last + 0.001 && (value !== null || !text)) parts.push([time, time, value, value, value === null ? 1 : 0, 1]);
    }
    return parts;
  }

  draw(colours = this.colours) {
    this.colours = colours;
    if (!this.row || !colours) return;
    const { begin, end, span } = this, { pen, width, height } = fit(this.canvas);
    if (!width) return;
    const all = this.parts(), first = all.findLastIndex(([, until]) => until < begin), after = all.findIndex(([from]) => from > end);
    const parts = all.slice(Math.max(first, 0), after < 0 ? undefined : after + 1); // with one beyond each edge, to which lines lead
    const inside = parts.filter(([from, until]) => until >= begin && from <= end);
    const numbers = parts.filter(([, , low]) => low !== null);
    let low = Math.min(...numbers.map(([, , one]) => one)), high = Math.max(...numbers.map(([, , , one]) => one));
    if (!numbers.length) [low, high] = [0, 1];
    const margin = (high - low) * 0.06 || Math.abs(high) * 0.05 || 1;
    low -= margin;
    high += margin;
    const x = (when) => LEFT + ((when - begin) / span) * (width - LEFT - RIGHT);
    const y = (value) => TOP + ((high - value) / (high - low)) * (height - TOP - BOTTOM);
    this.draw_ticks(pen, { x, y, low, high, width, height, any: numbers.length > 0 });
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, 0, width - LEFT - RIGHT, height);
    pen.clip();
    pen.strokeStyle = colours.late;
    pen.setLineDash([5, 4]);
    for (const bound of this.bounds) if (bound > low && bound < high) stroke(pen, [[LEFT, y(bound)], [width, y(bound)]]);
    pen.setLineDash([]);
    this.draw_values(pen, parts, x, y);
    pen.fillStyle = colours.bad;
    for (const [from, until, , , errors] of parts) if (errors) pen.fillRect(x(from) - 1, height - BOTTOM - 5, Math.max(x(until) - x(from), 2), 5);
    const found = this.at === null ? null : nearest(inside, begin + this.at * span);
    if (found) {
      pen.fillStyle = colours.ink;
      for (const value of new Set([found[2], found[3]])) if (value !== null) { pen.beginPath(); pen.arc(x((found[0] + found[1]) / 2), y(value), 4, 0, 7); pen.fill(); }
    }
    pen.restore();
    this.describe(inside, found);
  }

  draw_values(pen, parts, x, y) {
    const { colours } = this;
    pen.strokeStyle = pen.fillStyle = colours.ink;
    pen.lineWidth = 2;
    let before = null;
    for (const part of parts) {
      const [from, until, low, high, errors, samples] = part;
      if (low === null) { before = null; continue; }
      if (before) stroke(pen, [[x(before[1]), y((before[2] + before[3]) / 2)], [x(from), y((low + high) / 2)]]);
      else pen.fillRect(x(from) - 1, y(high) - 1, 2, 2);
      if (samples > 1) pen.fillRect(x(from), y(high), Math.max(x(until) - x(from), 1), Math.max(y(low) - y(high), 1));
      before = errors ? null : part;
    }
  }

  draw_ticks(pen, { x, y, low, high, width, height, any }) {
    const { colours, begin, end, span } = this;
    pen.strokeStyle = colours.rule;
    pen.fillStyle = colours.dim;
    pen.lineWidth = 1;
    pen.font = "11px system-ui, sans-serif";
    pen.strokeRect(LEFT, TOP, width - LEFT - RIGHT, height - TOP - BOTTOM);
    if (any) {
      const step = nice((high - low) / Math.max(Math.floor((height - TOP - BOTTOM) / 28), 2)), digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
      pen.textAlign = "right";
      for (let value = Math.ceil(low / step) * step; value < high; value += step) {
        stroke(pen, [[LEFT, y(value)], [width - RIGHT, y(value)]]);
        pen.fillText(Math.abs(value) >= 1e6 ? value.toExponential(2) : value.toFixed(Math.min(digits, 9)), LEFT - 5, y(value) + 4);
      }
    }
    const wanted = span / Math.max(Math.floor((width - LEFT - RIGHT) / 90), 2), step = TIMES.find((one) => one >= wanted) ?? TIMES.at(-1);
    const local = new Date(begin * 1000).getTimezoneOffset() * 60; // so that steps of hours and days begin at midnight here
    pen.textAlign = "center";
    for (let when = Math.ceil((begin - local) / step) * step + local; when <= end; when += step) {
      stroke(pen, [[x(when), TOP], [x(when), height - BOTTOM]]);
      const text = tick(when, step), half = pen.measureText(text).width / 2;
      if (x(when) + half < width && x(when) - half > 0) pen.fillText(text, x(when), height - 7);
    }
  }

  describe(inside, found) {
    const { row, loaded } = this, unit = row.unit ? ` ${row.unit}` : "";
    const named = (value) => loaded?.labels[value] ?? shown(value, row.precision) + unit;
    let text;
    if (found) {
      const [from, until, low, high, errors, samples] = found;
      const values = low === null ? "" : low === high ? named(low) : `${named(low)} to ${named(high)}`;
      const failed = errors ? (samples === 1 ? "no value" : `${errors} without a value`) : "";
      text = `${moment(from)}${samples > 1 ? ` to ${moment(until)}, ${samples} values` : ""}: ${[values, failed].filter(Boolean).join(", ")}`;
    } else if (this.failed) text = `✕ ${this.failed}`;
    else {
      const samples = inside.reduce((sum, part) => sum + part[5], 0);
      text = `${moment(this.begin)} to ${this.live ? "now" : moment(this.end)}: ${samples ? `${samples} values` : this.path !== null && !loaded ? "loading" : "no values"}`;
      if (this.path === null) text += `. Only the last values are here: this interface was started without --history.`;
    }
    if (this.note.textContent !== text) this.note.textContent = text;
  }
}

function nearest(parts, when) {
  const away = ([from, until]) => (when < from ? from - when : when > until ? when - until : 0);
  return parts.reduce((best, part) => (best === null || away(part) < away(best) ? part : best), null);
}

function stroke(pen, [[x, y], ...others]) {
  pen.beginPath();
  pen.moveTo(x, y);
  for (const [a, b] of others) pen.lineTo(a, b);
  pen.stroke();
}

// The next 1, 2 or 5 times a power of ten.
function nice(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((one) => one * power).find((one) => one >= least * 0.999);
}

const two = (number) => String(number).padStart(2, "0");

function day_of(at) {
  return `${at.getFullYear()}-${two(at.getMonth() + 1)}-${two(at.getDate())}`;
}

function tick(when, step) {
  const at = new Date(Math.round(when * 1000));
  if (step >= 86400) return day_of(at);
  const minutes = `${two(at.getHours())}:${two(at.getMinutes())}`;
  if (step >= 60) return minutes;
  return `${minutes}:${two(at.getSeconds())}${step < 1 ? `.${Math.floor(at.getMilliseconds() / 100)}` : ""}`;
}

function moment(when) {
  const at = new Date(when * 1000), today = day_of(at) === day_of(new Date());
  return `${today ? "" : `${day_of(at)} `}${two(at.getHours())}:${two(at.getMinutes())}:${two(at.getSeconds())}`;
}
