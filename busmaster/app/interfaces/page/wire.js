// The timeline of the wire: each exchange, retry, resynchronising and idle moment of the last seconds, the line's own lane
// first, then one for each node. What is wrong is lower as well as of another colour; a retry has a broken frame.

import { fit } from "./trend.js";
import { milliseconds } from "./line.js";

const KEPT_SECONDS = 31;
const MOST_KEPT = 20000;
const LATER = 0.4; // seconds: an exchange is shown when it has ended
const PLACES = [
  "said", "bytes", "ended", "protocol", "address", "command", "writes", "purpose", "request", "attempt", "verdict", "result", "late",
  "quiet_time",
];
const LANE = 14, LINE_LANE = 26, SCALE = 16, LEFT = 64;

export class Wire {
  constructor(canvas, tip, text) {
    Object.assign(this, { canvas, tip, text, exchanges: [], lanes: [], held: null, span: 2, chosen: null, left_out: 0 });
    canvas.addEventListener("pointermove", (event) => this.point(event));
    canvas.addEventListener("pointerdown", (event) => this.point(event));
    canvas.addEventListener("pointerleave", () => { tip.hidden = true; });
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  take({ exchanges, left_out, now }) {
    let before = this.exchanges.findLast((one) => one.verdict);
    for (const one of exchanges.map(exchange_of)) {
      if (one.verdict) {
        one.quiet = before ? Math.max(0, Math.min(one.quiet_time - before.quiet_time, one.begun - before.ended)) : 0;
        one.after = before?.ended ?? one.begun;
        before = one;
      }
      this.exchanges.push(one);
    }
    this.left_out = left_out;
    const first = this.exchanges.findIndex((one) => one.ended > now - KEPT_SECONDS);
    this.exchanges.splice(0, Math.max(first, this.exchanges.length - MOST_KEPT, 0));
  }

  clear() {
    this.exchanges = [];
    this.chosen = null;
  }

  hold(now) {
    this.held = this.held === null ? now : null;
    return this.held !== null;
  }

  draw(nodes, now, state) {
    this.lanes = nodes;
    this.end = (this.held ?? now) - (this.held === null ? LATER : 0);
    this.canvas.style.height = `${SCALE + LINE_LANE + nodes.length * LANE + 4}px`;
    const { pen, width, height } = fit(this.canvas);
    const style = getComputedStyle(document.documentElement);
    this.drawn = new Map(); // the last block of each lane, by its place
    const colours = new Map(); // each look into the style costs as much as four blocks
    const colour = (name) => {
      if (!colours.has(name)) colours.set(name, style.getPropertyValue(`--${name}`).trim());
      return colours.get(name);
    };
    const begin = this.end - this.span;
    this.x = (when) => LEFT + ((when - begin) / this.span) * (width - LEFT - 4);
    const lane_of = new Map(nodes.map((node, number) => [`${node.protocol}/${node.address}`, number]));
    pen.font = "11px system-ui, sans-serif";
    this.rules(pen, width, height, begin, colour);
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, 0, width - LEFT, height);
    pen.clip();
    for (const one of this.exchanges) {
      if (one.ended < begin || one.begun > this.end) continue;
      if (one.quiet > 0) this.resynchronising(pen, one.after, one.quiet, colour("resynchronising"));
      this.block(pen, one, SCALE, LINE_LANE - 4, colour);
      const lane = lane_of.get(`${one.protocol}/${one.address}`);
      if (lane !== undefined) this.block(pen, one, SCALE + LINE_LANE + lane * LANE, LANE - 3, colour);
    }
    if (state !== "ready" && this.held === null) this.still(pen, width, state, colour);
    if (this.chosen && this.chosen.ended > begin) {
      pen.strokeStyle = colour("focus");
      pen.lineWidth = 2;
      pen.strokeRect(this.x(this.chosen.begun) - 2, SCALE - 2, this.wide(this.chosen) + 4, LINE_LANE);
    }
    pen.restore();
  }

  rules(pen, width, height, begin, colour) {
    pen.fillStyle = colour("dim");
    pen.strokeStyle = colour("rule");
    pen.lineWidth = 1;
    const step = this.span / 4;
    for (let number = 0; number <= 4; number++) {
      const x = LEFT + (number / 4) * (width - LEFT - 4);
      pen.beginPath();
      pen.moveTo(x, SCALE - 3);
      pen.lineTo(x, height);
      pen.stroke();
      if (number % 2 && width < 500) continue; // the texts would touch
      const text = number === 4 ? (this.held === null ? "now" : "held") : `−${+(this.span - number * step).toFixed(3)} s`;
      pen.fillText(text, number === 4 ? x - pen.measureText(text).width : x + 2, 10);
    }
    pen.fillStyle = colour("ink");
    pen.fillText("line", 2, SCALE + 15);
    this.base(pen, SCALE + LINE_LANE - 4, width);
    this.lanes.forEach((node, number) => {
      const y = SCALE + LINE_LANE + number * LANE;
      pen.fillStyle = node.health === "down" ? colour("bad") : colour("ink");
      pen.fillText(fitting(pen, `${node.health === "down" ? "✕ " : ""}${node.label}`, LEFT - 6), 2, y + 10);
      this.base(pen, y + LANE - 3, width);
    });
  }

  base(pen, y, width) {
    pen.beginPath();
    pen.moveTo(LEFT, y + 0.5);
    pen.lineTo(width, y + 0.5);
    pen.stroke();
  }

  wide(one) { return Math.max(1.5, this.x(one.ended) - this.x(one.begun)); }

  block(pen, one, top, height, colour) {
    const kind = kind_of(one), x = this.x(one.begun), wide = this.wide(one);
    // where several exchanges share a pixel, one block of each kind is drawn there
    const plain = !one.writes && one.attempt <= 1 ? kind : "", drawn = this.drawn.get(top);
    if (plain && wide <= 1.5 && drawn?.plain === plain && x - drawn.x >= 0 && x - drawn.x < 0.5) return;
    this.drawn.set(top, { plain, x });
    const high = kind === "bad" ? height * 0.45 : kind === "late" ? height * 0.7 : height;
    pen.fillStyle = colour(kind);
    pen.fillRect(x, top + height - high, wide, high);
    if (one.writes) {
      pen.fillStyle = colour("ink");
      pen.fillRect(x, top, Math.max(wide, 3), 3);
    }
    if (one.attempt > 1) {
      pen.strokeStyle = colour("ink");
      pen.lineWidth = 1.5;
      pen.setLineDash([2, 2]);
      pen.strokeRect(x, top + 0.5, Math.max(wide, 3), height - 1);
      pen.setLineDash([]);
    }
  }

  resynchronising(pen, from, seconds, colour) {
    const x = this.x(from), wide = Math.max(1, this.x(from + seconds) - x);
    pen.save();
    pen.beginPath();
    pen.rect(x, SCALE + 6, wide, LINE_LANE - 10);
    pen.clip();
    pen.strokeStyle = colour;
    pen.lineWidth = 1.5;
    pen.beginPath();
    for (let at = x - 20; at < x + wide; at += 5) { pen.moveTo(at, SCALE + LINE_LANE); pen.lineTo(at + 20, SCALE + 2); }
    pen.stroke();
    pen.restore();
  }

  // What is since the last exchange, while the line is not ready: it is shown when it has ended.
  still(pen, width, state, colour) {
    const from = Math.max(this.end - this.span, this.exchanges.at(-1)?.ended ?? 0);
    if (state === "resynchronising") this.resynchronising(pen, from, this.end - from, colour("resynchronising"));
    const text = state === "resynchronising" ? "the line resynchronises" : "no line";
    if (this.x(this.end) - this.x(from) < pen.measureText(text).width + 8) return;
    pen.fillStyle = colour("ground");
    pen.fillRect(width - pen.measureText(text).width - 12, SCALE + 4, pen.measureText(text).width + 8, 16);
    pen.fillStyle = colour("bad");
    pen.fillText(text, width - pen.measureText(text).width - 8, SCALE + 16);
  }

  point(event) {
    const box = this.canvas.getBoundingClientRect();
    const x = event.clientX - box.left, y = event.clientY - box.top;
    const node = this.lanes[Math.floor((y - SCALE - LINE_LANE) / LANE)];
    const here = (one) => y < SCALE + LINE_LANE || (node && one.protocol === node.protocol && one.address === node.address);
    let best = null, least = 6;
    for (const one of this.exchanges) {
      const from = this.x(one.begun), away = Math.max(from - x, x - from - this.wide(one), 0);
      if (away < least && here(one)) { best = one; least = away; }
    }
    this.tip.hidden = false;
    if (best) this.describe(best);
    else this.tip.textContent = this.between(this.end - this.span + ((x - LEFT) / (box.width - LEFT - 4)) * this.span);
    this.tip.style.left = `${Math.max(4, Math.min(event.clientX + 14, innerWidth - this.tip.offsetWidth - 8))}px`;
    const below = event.clientY + 18;
    this.tip.style.top = `${below + this.tip.offsetHeight > innerHeight ? Math.max(4, event.clientY - this.tip.offsetHeight - 12) : below}px`;
  }

  between(when) {
    const now = this.exchanges.find((one) => one.verdict && one.begun <= when && when < one.ended);
    if (now) return `busy with ${label_of(now, this.lanes)}`;
    const next = this.exchanges.find((one) => one.verdict && one.begun > when);
    if (next && when < next.after + next.quiet) return `the line was quiet for ${milliseconds(next.quiet)}: a late reply could still arrive`;
    return next && next.after < when ? `idle for ${milliseconds(next.begun - next.after - next.quiet)}` : "idle";
  }

  key(event) {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step || !this.exchanges.length) return;
    event.preventDefault();
    if (this.held === null) this.canvas.dispatchEvent(new CustomEvent("hold"));
    const now = this.exchanges.indexOf(this.chosen);
    const last = this.exchanges.findLastIndex((one) => one.begun <= this.end);
    const next = now < 0 ? last : Math.max(0, Math.min(last, now + step));
    this.describe(this.exchanges[next]);
  }

  describe(one) {
    this.chosen = one;
    const text = description(one, this.lanes);
    this.tip.textContent = text;
    this.text.textContent = text.replaceAll("\n", " · ");
  }
}

// An exchange with named fields, in seconds; without a verdict: unexpected bytes.
function exchange_of(values) {
  const one = Object.fromEntries(values.map((value, place) => [PLACES[place], value]));
  one.said = one.said.map(([when, ...rest]) => [when / 1e6, ...rest]);
  one.begun = one.said[0][0];
  one.ended = one.verdict ? one.ended / 1e6 : one.said.at(-1)[0];
  if (one.verdict) one.quiet_time /= 1e6;
  return one;
}

function kind_of(one) {
  if (!one.verdict) return "bad";
  if (["no reply", "garbled", "spoilt", "cut off"].includes(one.verdict)) return "bad";
  if (one.verdict !== "ok" || one.late) return "late";
  return one.writes ? "write" : "ok";
}

function description(one, nodes) {
  const lines = one.said.map(([when, who, hex]) => `${who === "master" ? "→" : "←"} +${milliseconds(when - one.begun)}  ${spelled(hex)}`);
  if (!one.verdict) return [`unexpected: ${one.bytes} bytes without a request`, ...lines].join("\n");
  const answer = one.verdict === "ok" ? one.result || "done" : `${one.verdict}: ${one.result}`;
  const why = one.purpose ? `for ${one.purpose}` : "requested by a program";
  const first = one.said.find(([, who]) => who === "node");
  return [
    `${label_of(one, nodes)}: ${one.command} = ${answer}`,
    `${why}, request ${one.request}${one.attempt > 1 ? `, RETRY: attempt ${one.attempt}` : ""}${one.late ? ", LATE" : ""}`,
    `${milliseconds(one.ended - one.begun, 2)} in all${first ? `, first byte after ${milliseconds(first[0] - one.begun, 2)}` : ", nothing came"}`,
    ...lines,
  ].join("\n");
}

function label_of(one, nodes) {
  const node = nodes.find((node) => node.protocol === one.protocol && node.address === one.address);
  return node?.label ?? `${one.protocol} ${one.address}`;
}

function spelled(hex) {
  const bytes = hex.match(/../g) ?? [];
  const text = bytes.map((byte) => { const code = parseInt(byte, 16); return code > 32 && code < 127 ? String.fromCharCode(code) : "·"; });
  return `${bytes.join(" ")}  ${text.join("")}`;
}

function fitting(pen, text, width) {
  while (text.length > 1 && pen.measureText(text).width > width) text = text.slice(0, -1);
  return text;
}
