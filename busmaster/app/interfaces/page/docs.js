// The page of the REST API: what /openapi.json describes, and a form for each operation. It loads nothing from elsewhere.

import { element } from "./element.js";

const METHODS = ["get", "put", "post", "patch", "delete"];
const DEEPEST = 4; // levels of a schema that are shown
const by = (id) => document.getElementById(id);
let described = {};

function resolved(part) {
  while (part?.$ref) part = part.$ref.slice(2).split("/").reduce((found, name) => found[name], described);
  return part ?? {};
}

// A text of the description, with its names in backticks as code.
function prose(name, text) {
  const made = element(name);
  made.append(...text.split("`").map((part, number) => (number % 2 ? element("code", part) : part)));
  return made;
}

// schemas

function type_of(schema) {
  const part = resolved(schema);
  if (part.enum) return part.enum.map((one) => JSON.stringify(one)).join(" or ");
  if (part.type === "array" && part.items) return `array of ${type_of(part.items)}`;
  if (Array.isArray(part.type)) return part.type.join(" or ");
  return part.type ?? (part.allOf ? "object" : "any value");
}

function bounds_of(schema) {
  const { minimum, maximum, default: usual } = resolved(schema);
  const parts = [];
  if (minimum !== undefined) parts.push(`from ${minimum}`);
  if (maximum !== undefined) parts.push(`to ${maximum}`);
  const range = parts.join(" ");
  return [range, usual === undefined ? "" : `by default ${usual}`].filter(Boolean).join(", ");
}

// All parts of a schema that have properties, with those of an array's items.
function objects_in(schema) {
  const part = resolved(schema);
  if (part.type === "array" && part.items) return objects_in(part.items);
  return [part, ...(part.allOf ?? []).flatMap(objects_in)].filter((one) => one.properties);
}

function list_of(schema, depth = 0) {
  const list = element("ul", "", "schema");
  for (const part of objects_in(schema)) {
    for (const [name, of] of Object.entries(part.properties)) {
      const line = element("li"), about = resolved(of).description;
      line.append(element("code", name), " ", element("i", type_of(of) + (part.required?.includes(name) ? "" : ", optional")));
      if (about) line.append(": ", prose("span", about));
      if (depth < DEEPEST && objects_in(of).length) line.append(list_of(of, depth + 1));
      list.append(line);
    }
  }
  return list;
}

function replies_of(operation) {
  const box = element("details", "", "replies"), title = element("summary", "Replies");
  box.append(title);
  for (const [status, reply] of Object.entries(operation.responses)) {
    const { description, content } = resolved(reply), schema = content?.["application/json"]?.schema;
    const line = element("p");
    line.append(element("b", status), ` ${description}${schema ? `: ${type_of(schema)}` : ""}`);
    box.append(line);
    if (schema) box.append(list_of(schema));
  }
  return box;
}

// one operation

class Operation {
  constructor(method, path, operation, parameters) {
    Object.assign(this, { method, path, parameters, fields: new Map(), body: null, confirmed: false });
    this.box = element("details", "", "operation");
    this.box.id = `op-${operation.operationId}`; // page.css has rules for #points and others
    const title = element("summary");
    title.append(element("b", method.toUpperCase(), `method ${method}`), element("code", path), element("span", operation.summary));
    this.box.append(title);
    if (operation.description) this.box.append(prose("p", operation.description));
    const form = element("form");
    form.append(...this.inputs(), ...this.body_of(operation), this.buttons());
    form.addEventListener("submit", (event) => { event.preventDefault(); this.submit(); });
    form.addEventListener("input", () => this.confirm(false));
    this.result = element("div");
    this.result.setAttribute("role", "status");
    this.box.append(form, this.result, replies_of(operation));
  }

  inputs() {
    if (!this.parameters.length) return [];
    const box = element("div", "", "inputs");
    for (const parameter of this.parameters) {
      const field = element("input"), label = element("label", parameter.name + (parameter.required ? "" : " (optional)"));
      field.id = `${this.box.id}-${parameter.name}`;
      label.htmlFor = field.id;
      field.autocomplete = "off";
      field.spellcheck = false;
      field.dataset.parameter = parameter.name;
      this.fields.set(parameter.name, field);
      const type = [type_of(parameter.schema), bounds_of(parameter.schema)].filter(Boolean).join(" ");
      box.append(label, field, prose("small", `${type}. ${parameter.description ?? ""}`));
    }
    return [element("h3", "Parameters"), box];
  }

  body_of(operation) {
    const schema = operation.requestBody?.content["application/json"]?.schema;
    if (!schema) return [];
    this.body = element("textarea");
    this.body.id = `${this.box.id}-body`;
    this.body.spellcheck = false;
    this.body.placeholder = JSON.stringify(Object.fromEntries(Object.keys(resolved(schema).properties ?? {}).map((name) => [name, 12.5])));
    const label = element("label", "Body, as JSON");
    label.htmlFor = this.body.id;
    const title = element("h3");
    title.append(label);
    return [title, this.body, list_of(schema)];
  }

  buttons() {
    const box = element("div", "", "buttons");
    this.send = element("button", "", "go");
    this.send.type = "submit";
    this.back = element("button", "Cancel");
    this.back.type = "button";
    this.back.addEventListener("click", () => this.confirm(false));
    box.append(this.send, this.back);
    this.confirm(false);
    return box;
  }

  // What changes the line is confirmed first, as on the page of the line.
  confirm(asked) {
    this.confirmed = asked;
    this.back.hidden = !asked;
    const name = this.method.toUpperCase();
    this.send.textContent = asked ? `Send ${name} to the line` : this.method === "get" ? `Send ${name}` : `Send ${name}…`;
  }

  submit() {
    const missing = this.parameters.find(({ name, required }) => required && !this.fields.get(name).value);
    if (missing) return this.show(`Enter a value for ${missing.name}.`, "bad");
    if (this.body && !this.body.value.trim()) return this.show("Enter a body.", "bad");
    if (this.method !== "get" && !this.confirmed) {
      this.show("This changes the line. Send it?");
      return this.confirm(true);
    }
    this.confirm(false);
    return this.request();
  }

  url() {
    const value = (name) => this.fields.get(name).value;
    const path = this.path.replace(/\{(\w+)\}/g, (_, name) => value(name).split("/").map(encodeURIComponent).join("/"));
    const query = this.parameters.filter(({ in: where, name }) => where === "query" && value(name));
    return path + (query.length ? `?${query.map(({ name }) => `${name}=${encodeURIComponent(value(name))}`).join("&")}` : "");
  }

  async request() {
    const url = this.url(), headers = {}, token = by("token").value;
    if (this.body) headers["Content-Type"] = "application/json";
    if (token) headers.Authorization = `Bearer ${token}`;
    const begin = performance.now();
    this.send.disabled = true;
    try {
      const reply = await fetch(url, { method: this.method.toUpperCase(), headers, body: this.body?.value });
      const text = await reply.text(), milliseconds = Math.round(performance.now() - begin);
      this.show(`${reply.status} ${reply.statusText}, ${text.length} characters in ${milliseconds} ms`, reply.ok ? "good" : "bad", pretty(text), this.curl(url));
    } catch {
      this.show("The program of this page did not reply.", "bad", "", this.curl(url));
    } finally {
      this.send.disabled = false;
    }
  }

  curl(url) {
    const quoted = (text) => `'${text.replaceAll("'", "'\\''")}'`;
    const parts = ["curl", ...(this.method === "get" ? [] : ["-X", this.method.toUpperCase()])];
    if (by("token").value) parts.push("-H", quoted("Authorization: Bearer TOKEN"));
    if (this.body) parts.push("-H", quoted("Content-Type: application/json"), "-d", quoted(this.body.value));
    return [...parts, quoted(location.origin + url)].join(" ");
  }

  show(text, kind = "", body = "", command = "") {
    const parts = [element("p", text, `status ${kind}`)];
    for (const one of [body, command].filter(Boolean)) {
      const box = element("pre", one);
      box.tabIndex = 0;
      parts.push(box);
    }
    this.result.replaceChildren(...parts);
  }
}

function pretty(text) {
  try {
    return JSON.stringify(JSON.parse(text), null, 2);
  } catch {
    return text;
  }
}

// the page

async function fill_in(operations) {
  let points;
  try {
    points = await (await fetch("/api/points")).json();
  } catch {
    return;
  }
  if (!points.length) return;
  for (const { fields } of operations) {
    for (const [name, field] of fields) if (!field.value && name in points[0]) field.value = points[0][name];
  }
}

async function open() {
  try {
    described = await (await fetch("/openapi.json")).json();
  } catch {
    by("trouble").textContent = "/openapi.json could not be read. Load the page again.";
    by("trouble").hidden = false;
    return;
  }
  const { info, paths } = described;
  by("version").textContent = `${info.title}, version ${info.version}`;
  by("about").replaceChildren(...info.description.split("\n\n").map((text) => prose("p", text)));
  const operations = Object.entries(paths).flatMap(([path, item]) => METHODS.filter((method) => item[method]).map((method) => {
    const parameters = [...(item.parameters ?? []), ...(item[method].parameters ?? [])].map(resolved);
    return new Operation(method, path, item[method], parameters);
  }));
  by("operations").replaceChildren(...operations.map(({ box }) => box));
  if (location.hash) document.getElementById(location.hash.slice(1))?.setAttribute("open", "");
  await fill_in(operations);
}

by("token-form").addEventListener("submit", (event) => event.preventDefault());
open();
