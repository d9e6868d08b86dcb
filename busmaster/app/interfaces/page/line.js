// What is known of the line: put together from the messages of its owner, in any order.

const KEPT = 240; // values of a point, for its trend

export class Line {
  constructor() {
    this.state = { connected: false, why: "", read_only: true };
    this.frame = null;
    this.set = 0;
    this.parts = new Map(); // rows by the place of the first of them
    this.values = new Map();
    this.groups = new Map();
    this.nodes = new Map();
    this.known = new Map(); // trends, by what a point is called
    this.drawn = performance.now();
  }

  take({ method, body }) {
    switch (method) {
      case "state":
        if (body.connected && !this.state.connected) this.set = 0; // another owner, perhaps: it counts anew
        this.state = body;
        break;
      case "frame":
        this.begin(body.set);
        this.frame = body;
        this.received = performance.now();
        break;
      case "rows":
        this.begin(body.set);
        if (body.set === this.set) this.takeRows(body.first, body.rows);
        break;
      case "values":
        this.begin(body.set);
        if (body.set === this.set) {
          this.values.set(body.first, body.values);
          this.takeValues(body.first);
        }
        break;
      case "past": {
        const { rows } = this;
        body.past.forEach((past, number) => {
          const row = rows[number];
          if (row && row.past.length < 2) row.past = past.map(([when, value]) => [when, number_of(value)]);
        });
        body.last.forEach(([value, asked], number) => {
          const row = rows[number];
          if (row && row.asked === null) Object.assign(row, { value: plain(value), asked });
        });
        break;
      }
      case "groups":
      case "nodes":
        this[method].set(body.first, body[method]);
    }
  }

  begin(set) {
    if (set > this.set) {
      for (const row of this.rows) this.known.set(row.name, row);
      this.set = set;
      this.parts.clear();
      this.values.clear();
      this.groups.clear();
      this.nodes.clear();
    }
  }

  takeRows(first, rows) {
    this.parts.set(first, rows.map((row, number) => {
      const name = JSON.stringify([row.group, row.protocol, row.address, row.key, row.unit]);
      const before = this.known.get(name);
      this.known.delete(name); // two points may be called alike
      return { past: [], value: null, quality: "", asked: null, error: "", alarm: "", ...(before && kept(before)), ...row, name, place: first + number };
    }));
    this.takeValues(first);
  }

  takeValues(first) {
    const rows = this.parts.get(first) ?? [];
    (this.values.get(first) ?? []).forEach((held, number) => {
      const row = rows[number];
      if (!held || !row) return;
      const [value, quality, asked, error, alarm] = held;
      Object.assign(row, { error, alarm, quality }); // also of a value that was shown before: a write may have made it stale
      if (!(row.past.length && row.past.at(-1)[0] >= asked)) {
        row.past.push([asked, error ? null : number_of(value)]);
        if (row.past.length > KEPT) row.past.shift();
      }
      if (!error) Object.assign(row, { value: plain(value), asked });
    });
  }

  get rows() { return in_order(this.parts); }
  get all_groups() { return in_order(this.groups).slice(0, this.frame?.groups ?? 0); }
  get all_nodes() { return in_order(this.nodes).slice(0, this.frame?.nodes ?? 0); }

  // The line's time now: its owner's clock, as last received.
  get now() { return this.frame ? this.frame.now + (this.state.connected ? (performance.now() - this.received) / 1000 : 0) : 0; }
}

function in_order(parts) {
  return [...parts.keys()].sort((one, other) => one - other).flatMap((first) => parts.get(first));
}

function kept({ past, value, quality, asked, error, alarm }) {
  return { past, value, quality, asked, error, alarm };
}

// A number that JSON does not have is sent as {"float": "nan"}.
function plain(value) {
  return value !== null && typeof value === "object" && "float" in value ? value.float : value;
}

function number_of(value) {
  return typeof value === "number" ? value : null;
}

export function shown(value, precision) {
  if (value === null || value === undefined) return "–";
  if (typeof value !== "number") return String(value);
  if (precision !== null && precision !== undefined) return value.toFixed(precision);
  return Number.isInteger(value) ? String(value) : String(+value.toPrecision(7));
}

export function milliseconds(seconds, digits = 1) {
  return `${(seconds * 1000).toFixed(digits)} ms`;
}
