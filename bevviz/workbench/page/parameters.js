// Parameters by stage: a slider for a number, a box for each item of a list, and the search over all of them.

import { $, element, state } from "./page_state.js";

const STEPS = 200; // of a slider
const WIDE = 4; // times the opened value, where a parameter has no upper limit

/** @import { Control } from "./types" */
/** @typedef {(written: string) => void} Write */
/** @typedef {Map<string, string>} Changes values by key */

/** @type {Control[]} */
let controls = [];
/** @type {(settings: string[]) => void} */
let change = () => {};
const unfolded = new Set(); // stages that the user has unfolded

/** @param {typeof change} changing */
export function start(changing) {
  change = changing;
  $("search").oninput = show;
}

/** @param {Control[]} offered */
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
  if (focused?.startsWith("control-")) document.getElementById(focused)?.focus();
}

/**
 * @param {string[]} words
 * @param {Changes} changes
 */
function search(words, changes) {
  const found = controls.filter((one) => changes.has(one.key)
    || words.every((word) => `${one.key} ${one.about} ${one.unit}`.toLowerCase().includes(word)));
  // Changed parameters first, then those with the words in their name: 'eps' is also in 'keeps' of a description.
  const rank = (/** @type {Control} */ one) => (changes.has(one.key) ? 0 : 1 + Number(!words.every((word) => one.key.includes(word))));
  return found.sort((a, b) => rank(a) - rank(b));
}

/**
 * @param {string} name
 * @param {Changes} changes
 */
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

/**
 * @param {Control} one
 * @param {Changes} changes
 */
function control(one, changes) {
  const label = element("label", "", one.key);
  const value = changes.get(one.key) ?? (one.value ?? "");
  const low = one.low === null ? "" : `from ${one.low}`;
  const high = one.high === null ? "" : `up to ${one.high}`;
  const about = element("small", "", [one.about, one.unit, `${low} ${high}`.trim(), `opened with ${text(one.value ?? "nothing")}`]
    .filter(Boolean).join("; "));
  const set = (/** @type {string} */ written) => change([`${one.key}=${written === "" ? "null" : written}`]);
  const input = one.kind === "choice" ? choice(one, value, set) : one.kind === "list" ? list(one, value, set)
    : one.kind === "switch" ? onOff(value, set) : field(value, set);
  input.id = `control-${one.key}`;
  label.htmlFor = input.id;
  const row = element("div", changes.has(one.key) ? "control changed" : "control", "", label, input);
  if (input instanceof HTMLInputElement && (one.kind === "whole" || one.kind === "number")) {
    input.inputMode = "decimal";
    const slide = slider(one, value, input, set);
    if (slide) row.append(slide);
  }
  row.append(about);
  return row;
}

const text = (/** @type {unknown} */ value) => (typeof value === "object" && value !== null ? JSON.stringify(value) : String(value));

/**
 * @param {unknown} value
 * @param {Write} set
 */
function field(value, set) {
  const input = element("input", "", "");
  input.value = input.defaultValue = text(value);
  input.onchange = () => set(input.value);
  return input;
}

/**
 * @param {Control} one
 * @param {unknown} value
 * @param {Write} set
 */
function choice(one, value, set) {
  const input = element("select", "", "", ...one.choices.map((name) => new Option(name, name, false, name === value)));
  input.onchange = () => set(input.value);
  return input;
}

/**
 * @param {unknown} value
 * @param {Write} set
 */
function onOff(value, set) {
  const input = element("input", "", "");
  input.type = "checkbox";
  input.checked = String(value) === "true";
  input.onchange = () => set(String(input.checked));
  return input;
}

/**
 * A slider from the lowest value to the highest, or to a multiple of the opened value where there is no highest.
 * @param {Control} one
 * @param {unknown} value
 * @param {HTMLInputElement} input field beside it
 * @param {Write} set
 */
function slider(one, value, input, set) {
  const opened = Number(one.value);
  if (one.value === null || !Number.isFinite(opened)) return null;
  const low = one.low ?? Math.min(0, WIDE * opened);
  const high = Math.min(one.high ?? Infinity, Math.max(low + 1, WIDE * Math.abs(opened), Number(value) || 0));
  const slide = element("input", "slider", "");
  slide.type = "range";
  [slide.min, slide.max] = [String(low), String(high)];
  slide.step = one.kind === "whole" ? "1" : String(Number(((high - low) / STEPS).toPrecision(1)));
  slide.value = String(value);
  slide.ariaLabel = `${one.key}, slider`;
  slide.oninput = () => { input.value = slide.value; };
  slide.onchange = () => set(slide.value);
  return slide;
}

/**
 * @param {Control} one
 * @param {string | string[]} value
 * @param {Write} set
 */
function list(one, value, set) {
  const items = typeof value === "string" ? parsed(value) : [...value];
  const write = (/** @type {string[]} */ next) => set(JSON.stringify(next));
  const { choices } = one;
  if (choices.length) {
    return element("span", "items", "", ...choices.map((name) => {
      const box = onOff(items.includes(name), () => write(choices.filter((other) => (other === name ? box.checked : items.includes(other)))));
      return element("label", "", "", box, ` ${name}`);
    }));
  }
  const more = element("input", "", "");
  more.placeholder = "add";
  more.ariaLabel = `add to ${one.key}`;
  more.onchange = () => { if (more.value.trim()) write([...items, more.value.trim()]); };
  return element("span", "items", "", ...items.map((item, row) => {
    const button = element("button", "", `${item} ×`);
    button.ariaLabel = `remove ${item}`;
    button.onclick = () => write(items.filter((_, other) => other !== row));
    return button;
  }), more);
}

/**
 * @param {string} value
 * @returns {string[]}
 */
function parsed(value) {
  try { return /** @type {string[]} */ ([]).concat(JSON.parse(value) ?? []); } catch { return value ? [value] : []; }
}
