// Table of all findings of the drive: missed and false objects, differences, anomalies and notes.

import { $, at, element, remember, spanText, state, stated } from "./page_state.js";
import { away, cause, csv, hasCause, KINDS, matches, offerFilters, severity, sorted } from "./triage.js";
import { seek, showSide } from "./viewer.js";

const SHOWN = 300; // rows in the page, at most
const REMARKED = 10; // rows whose hint is searched without a click
const PAUSE = 200; // ms between two updates of the page
const DOTS = 3; // most reasons of a severity

const entries = new Map(); // findings by number, notes by stamp and text
const hidden = new Set(["handled"]); // kinds that the user has switched off
let handled = []; // findings that the user has marked as done or ignored
let rows = []; // findings in the table, in order
let current = null; // key of the newest finding that was chosen
let isSubject = false; // what is asked about is the chosen finding
let sight = 0; // index of the chosen frame of the finding
const does = {}; // what the panel does: ask, tryOut, forget, remarks, unnote, handle, drawn

export function start(actions) {
  Object.assign(does, actions);
  $("next").onclick = () => step(1);
  $("previous").onclick = () => step(-1);
  for (const id of ["here", "grouped", "class", "reason", "within"]) $(id).onchange = draw;
  $("find").oninput = draw;
  $("csv").onclick = save;
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
    const sights = [{ frame: null, stamp: one.stamp, distance: null, pick: one.pick, tried: false, text: one.text, remark: "", in_way: false }];
    entries.set(key, { key, what: "note", name: one.about || (one.end === "0" ? "frame" : "span"), sights, note: one });
  }
  handled = message.findings;
  $("note-error").textContent = message.error;
  draw();
}

// Show in the row of an object whether a change helps.
export function explain({ frame, pick, remark, chip }, tried = false) {
  for (const { sights } of entries.values()) {
    const one = sights.find((other) => other.frame === frame && other.pick === pick && other.tried === tried);
    if (one) Object.assign(one, { remark: remark || " ", chip });
  }
  draw();
}

// Something else is asked about. The next finding is still the one after the chosen one.
export function leave() {
  if (!isSubject) return;
  isSubject = false;
  draw();
}

// --- drawing ------------------------------------------------------------------------------------

const nearest = (entry) => entry.sights.reduce((best, one, row) => (away(one) < away(entry.sights[best]) ? row : best), 0);
const here = (entry) => entry.sights.findIndex((one) => Math.abs(Number(one.stamp) - Number(state.time)) < 2000);
const kindOf = (entry) => (entry.handled ? "handled" : entry.what);

// A mark belongs to the finding that has its object at its frame.
const marks = (entry) => (mark) => mark.what === entry.what && mark.name === entry.name && entry.sights.some((one) => (
  one.stamp === mark.stamp && one.pick === mark.pick && (one.distance === mark.distance || Math.abs(one.distance - mark.distance) < 0.5)));

let waiting = 0;
export function draw() {
  waiting ||= setTimeout(() => {
    waiting = 0;
    if (document.activeElement?.closest("#found input")) draw(); // The user is typing.
    else redraw();
  }, PAUSE);
}

function redraw() {
  const only = $("here").checked && state.time !== null;
  for (const entry of entries.values()) {
    entry.best = only && here(entry) >= 0 ? here(entry) : nearest(entry);
    entry.handled = handled.find(marks(entry)) ?? null;
  }
  offerFilters([...entries.values()]);
  const shown = [...entries.values()].filter((entry) => (!only || here(entry) >= 0) && matches(entry));
  rows = sorted(shown.filter((entry) => !hidden.has(kindOf(entry))));
  $("found-none").hidden = rows.length > 0;
  $("found-none").textContent = entries.size ? "No finding matches." : "None so far.";
  $("found-title").textContent = `Worth a look: ${rows.length}`;
  kinds(shown);
  let before = null;
  replaceRows(rows.slice(0, SHOWN).flatMap((entry) => {
    const head = $("grouped").checked && cause(entry) !== before;
    before = cause(entry);
    const number = head ? rows.filter((one) => cause(one) === before).length : 0;
    return head ? [element("li", "group", `${before}: ${number}`), drawn(entry)] : [drawn(entry)];
  }));
  requestRemarks();
  does.drawn?.(rows);
  begin();
}

// Replace the rows that differ. A row that is replaced while a mouse button is down on it misses the click.
function replaceRows(items) {
  const list = $("found");
  for (const [row, item] of items.entries()) {
    const known = list.children[row];
    if (!known) list.append(item);
    else if (known.dataset.key !== item.dataset.key || known.outerHTML !== item.outerHTML) known.replaceWith(item);
  }
  while (list.children.length > items.length) list.lastChild.remove();
}

// Ask for the sentences that the first rows lack. The server answers when it has nothing else to do.
let requested = "";
function requestRemarks() {
  const lacking = rows.slice(0, REMARKED).map((entry) => entry.sights[entry.best])
    .filter((one) => one.pick && !one.tried && !one.remark && one.frame !== null).map(({ frame, pick }) => ({ frame, pick }));
  if (!lacking.length || JSON.stringify(lacking) === requested) return;
  requested = JSON.stringify(lacking);
  does.remarks?.(lacking);
}

function kinds(shown) {
  const counts = new Map();
  for (const entry of shown) counts.set(kindOf(entry), (counts.get(kindOf(entry)) ?? 0) + 1);
  const offered = [...KINDS, "handled"].filter((kind) => counts.has(kind) || (hidden.has(kind) && kind !== "handled"));
  const text = (kind) => `${kind} ${counts.get(kind) ?? 0}`;
  const same = [...$("kinds").children].map((one) => one.textContent).join() === offered.map(text).join();
  if (same) return;
  $("kinds").replaceChildren(...offered.map((kind) => {
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

const isSpan = (entry) => Boolean(entry.note) && entry.note.end !== "0";

function frames(entry) {
  const numbers = entry.sights.map((one) => one.frame);
  if (numbers.length < 2) return "";
  const [low, high] = [Math.min(...numbers), Math.max(...numbers)];
  return high - low + 1 === numbers.length ? `frames ${low}–${high}` : `${numbers.length} frames, ${low}–${high}`;
}

function drawn(entry) {
  const isChosen = isSubject && entry.key === current;
  const one = entry.sights[isChosen ? Math.min(sight, entry.sights.length - 1) : entry.best];
  const reasons = severity(entry);
  const filled = entry.what === "anomaly" && reasons.length ? DOTS : reasons.length;
  const dots = element("span", "dots", "●".repeat(filled) + "○".repeat(DOTS - filled));
  dots.title = reasons.join("; ") || "no reason to hurry";
  const [name, away, reason] = [element("span", "name", entry.name), element("span", "away", one.distance === null ? "" : `${one.distance} m`),
    element("span", "reason", one.text)];
  const button = element("button", "", "", dots, element("span", "time", isSpan(entry) ? spanText({ first: one.stamp, last: entry.note.end }) : at(one.stamp, one.frame)),
    element("span", entry.what.replace(" ", "-"), entry.what), name, away, reason);
  reason.title = state.meanings[one.text] ?? one.text;
  button.title = [frames(entry), one.remark].filter((more) => more?.trim()).join("\n");
  if (one.chip) button.append(element("span", `chip ${one.chip.replaceAll(" ", "-")}`, one.chip));
  button.setAttribute("aria-current", isChosen);
  button.onclick = () => choose(entry, isChosen ? sight + 1 : entry.best);
  const item = element("li", entry.handled ? "handled" : "", "", button);
  item.dataset.key = entry.key;
  if (entry.note) item.append(small("×", "remove this note", () => does.unnote(entry.note)));
  else if (entry.handled) {
    const { state: became, text: why } = entry.handled;
    item.append(element("span", "faint", `${became}${why ? `: ${why}` : ""}`), small("reopen", "list it again", () => mark(entry, "")));
  } else if (isChosen && does.handle && (hasCause(entry) || entry.what === "anomaly") && !one.tried) {
    const why = element("input", "", "");
    why.placeholder = "why (optional)";
    why.setAttribute("aria-label", "why it is done or ignored");
    item.append(why, small("done", "it is dealt with", () => mark(entry, "done", why.value)),
      small("ignore", "it is of no concern", () => mark(entry, "ignored", why.value)));
  }
  return item;
}

function small(text, meaning, action) {
  const button = element("button", "small", text);
  button.title = meaning;
  button.setAttribute("aria-label", meaning);
  button.onclick = action;
  return button;
}

function mark(entry, became, text = "") {
  const one = entry.sights[entry.best];
  const known = entry.handled ?? { stamp: one.stamp, what: entry.what, name: entry.name, pick: one.pick, distance: one.distance };
  does.handle({ ...known, state: became, text });
}

function save() {
  const link = element("a", "", "");
  link.href = URL.createObjectURL(new Blob([csv(rows)], { type: "text/csv" }));
  link.download = `${state.bag}.findings.csv`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// --- choosing -----------------------------------------------------------------------------------

// A page that shows nothing yet begins at the worst row that has a hint, once the rows above it are known to have none.
let hasBegun = Boolean(stated.get("at"));
for (const sign of ["pointerdown", "keydown"]) window.addEventListener(sign, () => { hasBegun = true; }, true);
function begin() {
  if (hasBegun || !does.remarks || state.pick || state.time === null) return;
  for (const entry of rows.slice(0, REMARKED)) {
    const one = entry.sights[entry.best];
    if (one.chip === "hint") {
      hasBegun = true;
      choose(entry, entry.best, false);
      return;
    }
    if (one.pick && !one.tried && !one.remark) return;
  }
}

export function step(by) {
  if (!rows.length) return;
  const at = rows.findIndex((entry) => entry.key === current);
  const entry = rows[at < 0 && by < 0 ? rows.length - 1 : (at + by + rows.length) % rows.length];
  choose(entry, entry.best);
}

export function choose(entry, which, scrolls = true) {
  current = entry.key;
  isSubject = true;
  sight = which % entry.sights.length;
  const { stamp, pick, tried } = entry.sights[sight];
  redraw();
  showRow(scrolls);
  if (tried || entry.what.endsWith("gone")) does.tryOut(tried);
  const origin = { time: Number(stamp), set: tried ? does.tryOut.settings() : [] }; // The pick is valid there.
  remember(Boolean(state.pick));
  [state.pick, state.origin] = [pick, origin];
  seek(stamp);
  showSide();
  remember();
  if (isSpan(entry)) does.markSpan({ first: stamp, last: entry.note.end });
  if (pick) does.ask({ pick, origin });
  else does.forget();
}

const isNarrow = () => matchMedia("(max-width: 800px)").matches;
let scrollsToAnswer = false; // once it has come

// Scroll a narrow page to the answer about a chosen row, below the list.
export function showAnswer() {
  if (scrollsToAnswer) $("answer").scrollIntoView({ block: "start" });
  scrollsToAnswer = false;
}

// Scroll the list to the chosen row, and a wide panel to the list.
function showRow(scrolls) {
  const [list, item] = [$("found"), [...$("found").children].find((one) => one.dataset.key === String(current))];
  if (!item) return;
  const top = item.offsetTop - list.offsetTop;
  if (top < list.scrollTop) list.scrollTop = top;
  else if (top + item.offsetHeight > list.scrollTop + list.clientHeight) list.scrollTop = top + item.offsetHeight - list.clientHeight;
  document.documentElement.style.setProperty("--list-height", `${$("findings").offsetHeight}px`);
  if (!scrolls) return;
  scrollsToAnswer = isNarrow();
  if (!isNarrow()) $("findings").parentElement.scrollTop = Math.min($("findings").parentElement.scrollTop, $("findings").previousElementSibling.offsetTop);
}
