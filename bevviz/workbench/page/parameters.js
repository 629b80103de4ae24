// Parameters by stage: a slider for a number, a box for each item of a list, and the search over all of them.

import { $, element, state } from "./page_state.js";

const STEPS = 200; // of a slider
const WIDE = 4; // times the opened value, where a parameter has no upper limit

let controls = [];
let change = () => {};
const unfolded = new Set(); // stages that the user has unfolded

export function start(changing) {
  change = changing;
  $("search").oninput = show;
}

export function offer(offered) {
  controls = offered;
  show();
}

export function show() {
  const words = $("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  const changes = new Map(state.set.map((one) => [one.slice(0, one.indexOf("=")), one.slice(one.indexOf("=") + 1)]));
  const focused = document.activeElement?.id;
  const found = words.length ? search(words, changes) : controls.filter((one) => changes.has(one.key));
  const stages = words.length ? [] : [...new Set(controls.map((one) => one.key.split(".")[0]))];
  $("controls").replaceChildren(...found.map((one) => control(one, changes)),
    ...stages.map((name) => stage(name, changes)));
  if (focused?.startsWith("control-")) $(focused)?.focus();
}

function search(words, changes) {
  const found = controls.filter((one) => changes.has(one.key)
    || words.every((word) => `${one.key} ${one.about} ${one.unit}`.toLowerCase().includes(word)));
  // Changed parameters first, then those with the words in their name: 'eps' is also in 'keeps' of a description.
  const rank = (one) => (changes.has(one.key) ? 0 : 1 + Number(!words.every((word) => one.key.includes(word))));
  return found.sort((a, b) => rank(a) - rank(b));
}

function stage(name, changes) {
  const own = controls.filter((one) => one.key.startsWith(`${name}.`));
  const changed = own.filter((one) => changes.has(one.key)).length;
  const fold = element("details", "", "", element("summary", "", changed ? `${name} (${changed} changed)` : name));
  const fill = () => fold.append(...own.filter((one) => !changes.has(one.key)).map((one) => control(one, changes)));
  fold.open = unfolded.has(name);
  if (fold.open) fill();
  fold.ontoggle = () => {
    if (fold.open === unfolded.has(name)) return;
    if (fold.open) { unfolded.add(name); fill(); } else { unfolded.delete(name); for (const one of [...fold.children].slice(1)) one.remove(); }
  };
  return fold;
}

function control(one, changes) {
  const label = element("label", "", one.key);
  const value = changes.get(one.key) ?? (one.value ?? "");
  const low = one.low === undefined ? "" : `from ${one.low}`;
  const high = one.high === undefined ? "" : `up to ${one.high}`;
  const about = element("small", "", [one.about, one.unit, `${low} ${high}`.trim(), `opened with ${text(one.value ?? "nothing")}`]
    .filter(Boolean).join("; "));
  const set = (written) => change([`${one.key}=${written === "" ? "null" : written}`]);
  const input = one.kind === "choice" ? choice(one, value, set) : one.kind === "list" ? list(one, value, set)
    : one.kind === "switch" ? onOff(value, set) : field(value, set);
  input.id = `control-${one.key}`;
  label.htmlFor = input.id;
  const row = element("div", changes.has(one.key) ? "control changed" : "control", "", label, input);
  if (one.kind === "whole" || one.kind === "number") {
    input.inputMode = "decimal";
    const slide = slider(one, value, input, set);
    if (slide) row.append(slide);
  }
  row.append(about);
  return row;
}

const text = (value) => (typeof value === "object" && value !== null ? JSON.stringify(value) : String(value));

function field(value, set) {
  const input = element("input", "", "");
  input.value = input.defaultValue = text(value);
  input.onchange = () => set(input.value);
  return input;
}

function choice(one, value, set) {
  const input = element("select", "", "", ...one.choices.map((name) => new Option(name, name, false, name === value)));
  input.onchange = () => set(input.value);
  return input;
}

function onOff(value, set) {
  const input = element("input", "", "");
  input.type = "checkbox";
  input.checked = String(value) === "true";
  input.onchange = () => set(String(input.checked));
  return input;
}

// A slider from the lowest value to the highest, or to a multiple of the opened value where there is no highest.
function slider(one, value, input, set) {
  const opened = Number(one.value);
  if (one.value === null || !Number.isFinite(opened)) return null;
  const low = one.low ?? Math.min(0, WIDE * opened);
  const high = Math.min(one.high ?? Infinity, Math.max(low + 1, WIDE * Math.abs(opened), Number(value) || 0));
  const slide = element("input", "slider", "");
  slide.type = "range";
  [slide.min, slide.max] = [low, high];
  slide.step = one.kind === "whole" ? 1 : Number(((high - low) / STEPS).toPrecision(1));
  slide.value = value;
  slide.setAttribute("aria-label", `${one.key}, slider`);
  slide.oninput = () => { input.value = slide.value; };
  slide.onchange = () => set(slide.value);
  return slide;
}

function list(one, value, set) {
  const items = typeof value === "string" ? parsed(value) : [...value];
  const write = (next) => set(JSON.stringify(next));
  if (one.choices) {
    return element("span", "items", "", ...one.choices.map((name) => {
      const box = onOff(items.includes(name), () => write(one.choices.filter((other) => (other === name ? box.checked : items.includes(other)))));
      return element("label", "", "", box, ` ${name}`);
    }));
  }
  const more = element("input", "", "");
  more.placeholder = "add";
  more.setAttribute("aria-label", `add to ${one.key}`);
  more.onchange = () => { if (more.value.trim()) write([...items, more.value.trim()]); };
  return element("span", "items", "", ...items.map((item, row) => {
    const button = element("button", "", `${item} ×`);
    button.setAttribute("aria-label", `remove ${item}`);
    button.onclick = () => write(items.filter((_, other) => other !== row));
    return button;
  }), more);
}

function parsed(value) {
  try { return [].concat(JSON.parse(value) ?? []); } catch { return value ? [value] : []; }
}
