// Ranked list of findings: missed and false objects, differences, anomalies and notes.

import { $, element, remember, seconds, state } from "./page_state.js";
import { seek, showSide } from "./viewer.js";

const SHOWN = 300; // rows in the page, at most
const REMARKED = 10; // rows whose hint is searched without a click
const PAUSE = 200; // ms between two updates of the page
const KINDS = ["missed", "lost", "contradicted", "unmatched", "doubtful", "broken", "new false", "fixed", "false gone", "new", "gone",
  "unnamed", "false", "anomaly", "note"];
const RANK = new Map(KINDS.map((kind, row) => [kind, row]));
RANK.set("unmatched", 0);

const entries = new Map(); // findings by number, notes by stamp and text
const hidden = new Set(); // kinds that the user has switched off
let rows = []; // findings in the list, in order
let current = null; // key of the chosen finding
let sight = 0; // index of the chosen frame of the finding
let ask = () => {};
let tryOut = () => {};
let forget = () => {};

export function start(asking, trying, forgetting) {
  forget = forgetting;
  ask = asking;
  tryOut = trying;
  $("next").onclick = () => step(1);
  $("previous").onclick = () => step(-1);
  $("here").onchange = draw;
}

export function restart() {
  entries.clear();
  current = null;
}

export function update(message) {
  for (const number of message.gone) entries.delete(number);
  for (const one of message.entries) {
    const known = entries.get(one.number);
    if (known) known.sights.push(...one.sights);
    else entries.set(one.number, { key: one.number, ...one });
  }
  draw();
}

export function notes(message) {
  for (const key of [...entries.keys()]) if (typeof key === "string") entries.delete(key);
  for (const one of message.notes) {
    const key = `${one.stamp} ${one.text}`;
    const sights = [[null, one.stamp, null, one.pick, false, one.text]];
    entries.set(key, { key, what: "note", name: one.about || "frame", sights, note: one });
  }
  $("note-error").textContent = message.error;
  draw();
}

// Show a hint, or that no tried change helps, in the row of an object. A sight keeps the sentence after its own text.
export function explain(frame, pick, tried, sentence) {
  for (const { sights } of entries.values()) {
    const one = sights.find((sight) => sight[0] === frame && sight[3] === pick && sight[4] === tried);
    if (one) one[6] = sentence;
  }
  draw();
}

// --- drawing ------------------------------------------------------------------------------------

const away = (one) => one[2] ?? 99;
const nearest = (entry) => entry.sights.reduce((best, one, row) => (away(one) < away(entry.sights[best]) ? row : best), 0);
const here = (entry) => entry.sights.findIndex((one) => Math.abs(Number(one[1]) - Number(state.time)) < 2000);

let waiting = 0;
export function draw() {
  if (!waiting) waiting = setTimeout(() => { waiting = 0; redraw(); }, PAUSE);
}

function redraw() {
  const only = $("here").checked && state.time !== null;
  const shown = [...entries.values()].filter((entry) => !only || here(entry) >= 0);
  for (const entry of shown) entry.best = only ? here(entry) : nearest(entry);
  rows = shown.filter((entry) => !hidden.has(entry.what)).sort((a, b) => (RANK.get(a.what) - RANK.get(b.what))
    || (away(a.sights[a.best]) - away(b.sights[b.best])) || (Number(a.sights[0][1]) - Number(b.sights[0][1])));
  $("found-none").hidden = rows.length > 0;
  $("found-title").textContent = `Worth a look: ${rows.length}`;
  filters(shown);
  $("found").replaceChildren(...rows.slice(0, SHOWN).map(drawn));
  requestRemarks();
}

// Ask for the sentences that the first rows lack. The server answers when it has nothing else to do.
let requested = "";
let bare = () => {};
export const onBare = (send) => { bare = send; };
function requestRemarks() {
  const lacking = rows.slice(0, REMARKED).map((entry) => entry.sights[entry.best])
    .filter((one) => one[3] && !one[4] && !one[6] && one[0] !== null).map((one) => [one[0], one[3]]);
  if (!lacking.length || JSON.stringify(lacking) === requested) return;
  requested = JSON.stringify(lacking);
  bare(lacking);
}

function filters(shown) {
  const counts = new Map();
  for (const { what } of shown) counts.set(what, (counts.get(what) ?? 0) + 1);
  const kinds = KINDS.filter((kind) => counts.has(kind) || hidden.has(kind));
  const text = (kind) => `${kind} ${counts.get(kind) ?? 0}`;
  const same = [...$("kinds").children].map((one) => one.textContent).join() === kinds.map(text).join();
  if (same) return;
  $("kinds").replaceChildren(...kinds.map((kind) => {
    const button = element("button", kind.replace(" ", "-"), text(kind));
    button.setAttribute("aria-pressed", !hidden.has(kind));
    button.onclick = () => {
      if (!hidden.delete(kind)) hidden.add(kind);
      button.setAttribute("aria-pressed", !hidden.has(kind));
      redraw();
    };
    return button;
  }));
}

function frames(entry) {
  const numbers = entry.sights.map((one) => one[0]);
  if (numbers.length < 2) return "";
  const [low, high] = [Math.min(...numbers), Math.max(...numbers)];
  return high - low + 1 === numbers.length ? `frames ${low}–${high}` : `${numbers.length} frames, ${low}–${high}`;
}

function drawn(entry) {
  const one = entry.sights[entry.best];
  const where = one[2] === null ? "" : ` at ${one[2]} m`;
  const text = `${entry.name}${where}${one[5] ? `: ${one[5]}` : ""}`;
  const button = element("button", "", "", element("span", "time", seconds(one[1])),
    element("span", entry.what.replace(" ", "-"), entry.what),
    element("span", "", text, ...(one[6] ? [element("small", "", one[6])] : [])),
    element("span", "faint", frames(entry)));
  button.setAttribute("aria-current", entry.key === current);
  button.onclick = () => choose(entry, entry.key === current ? sight + 1 : entry.best);
  const item = element("li", "", "", button);
  if (entry.note) {
    const remove = element("button", "remove", "×");
    remove.title = "remove this note";
    remove.setAttribute("aria-label", "remove this note");
    remove.onclick = () => removeNote(entry.note);
    item.append(remove);
  }
  return item;
}

let removeNote = () => {};
export const onRemove = (remove) => { removeNote = remove; };

// --- choosing -----------------------------------------------------------------------------------

export function step(by) {
  if (!rows.length) return;
  const at = rows.findIndex((entry) => entry.key === current);
  const entry = rows[at < 0 && by < 0 ? rows.length - 1 : (at + by + rows.length) % rows.length];
  choose(entry, entry.best);
}

function choose(entry, which) {
  current = entry.key;
  sight = which % entry.sights.length;
  const [, stamp, , pick, tried] = entry.sights[sight];
  for (const [row, item] of [...$("found").children].entries()) {
    item.firstChild.setAttribute("aria-current", rows[row]?.key === current);
  }
  $("found").children[rows.indexOf(entry)]?.scrollIntoView({ block: "nearest" });
  if (tried || entry.what.endsWith("gone")) tryOut(tried);
  const from = { time: Number(stamp), set: tried ? tryOut.settings() : [] }; // The pick is valid there.
  seek(stamp);
  showSide();
  state.pick = "";
  remember();
  if (pick) ask({ pick, from });
  else forget();
}
