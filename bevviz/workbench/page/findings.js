// Table of all findings of the drive: missed and false objects, differences, anomalies and notes.

import { $, at, element, remember, spanText, state, stated } from "./page_state.js";
import { KINDS } from "./lanes.js";
import { away, cause, csv, hasCause, level, matches, similar, sorted } from "./triage.js";
import { seek, showSide } from "./viewer.js";

const SHOWN = 300; // rows in the page, at most
const REMARKED = 10; // rows whose hint is searched without a click
const PAUSE = 200; // ms between two updates of the page
const DOTS = 3; // most reasons of a severity

/** @import { Entries, HandledFinding, Note, Notes, Origin, Remark, Row, Span } from "./types" */
/** @import { Finding, RowSight } from "./triage.js" */

/**
 * What the panel does. A robot has neither hints behind the list nor a bag to keep notes beside.
 * @typedef {object} Actions
 * @property {(what: { pick: string, origin: Origin }) => void} ask
 * @property {(withThem: boolean) => void} tryOut
 * @property {() => string[]} triedSet values of the newest trial
 * @property {() => void} forget
 * @property {(span: Span) => void} markSpan
 * @property {(rows: Finding[]) => void} drawn
 * @property {(rows: Row[]) => void} [remarks]
 * @property {(finding: HandledFinding) => void} [handle]
 * @property {(note: Note) => void} unnote
 */

/** @type {Map<number | string, Finding>} */
const entries = new Map(); // findings by number, notes by stamp and text
const hidden = new Set(["handled"]); // kinds that the user has switched off
/** @type {HandledFinding[]} */
let handled = []; // findings that the user has marked as done or ignored
/** @type {Finding[]} */
let rows = []; // findings in the table, in order
/** @type {number | string | null} */
let current = null; // key of the newest finding that was chosen
let isSubject = false; // what is asked about is the chosen finding
let sight = 0; // index of the chosen frame of the finding
/** @type {Actions} */
let does;

/** @param {Actions} actions */
export function start(actions) {
  does = actions;
  $("next").onclick = () => step(1);
  $("previous").onclick = () => step(-1);
  for (const id of /** @type {const} */ (["here", "grouped", "class", "reason", "within"])) $(id).onchange = draw;
  $("find").oninput = draw;
  $("csv").onclick = save;
}

export function restart() {
  entries.clear();
  current = null;
}

/** @param {Entries} message */
export function update(message) {
  for (const number of message.gone) entries.delete(number);
  for (const one of message.entries) {
    const known = entries.get(one.number);
    if (known) {
      known.sights.push(...one.sights);
      Object.assign(known, one, { sights: known.sights });
    } else entries.set(one.number, { key: one.number, best: 0, handled: null, ...one });
  }
  draw();
}

/** @param {Notes} message */
export function notes(message) {
  for (const key of [...entries.keys()]) if (typeof key === "string") entries.delete(key);
  for (const one of message.notes) {
    const key = `${one.stamp} ${one.text}`;
    const sights = [{ frame: null, stamp: one.stamp, distance: null, pick: one.pick, tried: false, text: one.text, remark: "", in_way: false }];
    const name = one.about || (one.end === "0" ? "frame" : "span");
    entries.set(key, { key, what: "note", name, reasons: [], rank: [0, 1, Number(one.stamp)], sights, best: 0, handled: null, note: one });
  }
  handled = message.findings;
  $("note-error").textContent = message.error;
  draw();
}

/**
 * Show in the row of an object its reason, and whether a change helps.
 * @param {Omit<Remark, "type">} row
 */
export function explain({ frame, pick, remark, chip, text }, tried = false) {
  for (const { sights } of entries.values()) {
    const one = sights.find((other) => other.frame === frame && other.pick === pick && other.tried === tried);
    if (one) Object.assign(one, { remark: remark || " ", chip, text: text || one.text });
  }
  draw();
}

/**
 * Buttons of what can be done about a listed object that no change helps.
 * @param {number} frame
 * @param {string} pick
 */
export function nextSteps(frame, pick) {
  const all = [...entries.values()];
  const own = all.find((entry) => hasCause(entry) && entry.sights.some((one) => one.frame === frame && one.pick === pick && !one.tried));
  if (!own) return [];
  const steps = similar(own, all).map((entry) => {
    const one = entry.sights[entry.best];
    const facts = [at(one.stamp, one.frame), one.distance === null ? "" : `${one.distance} m`, one.text].filter(Boolean).join(", ");
    return offered(`see a similar case: ${entry.what} ${entry.name}`, facts, () => choose(entry, entry.best));
  });
  if (does.handle && !own.handled && own.what === "unmatched") {
    steps.unshift(offered("nothing was missed", "a false detection: ignore this finding", () => mark(own, "ignored", "the detector's own: nothing was missed")));
  }
  return steps;
}

/**
 * @param {string} text
 * @param {string} meaning
 * @param {() => void} action
 */
export function offered(text, meaning, action) {
  const button = element("button", "", text, element("small", "", meaning));
  button.onclick = action;
  return button;
}

// Something else is asked about. The next finding is still the one after the chosen one.
export function leave() {
  if (!isSubject) return;
  isSubject = false;
  draw();
}

// --- drawing ------------------------------------------------------------------------------------

const nearest = (/** @type {Finding} */ entry) => entry.sights.reduce((best, one, row) => (away(one) < away(entry.sights[best]) ? row : best), 0);
const here = (/** @type {Finding} */ entry) => entry.sights.findIndex((one) => Math.abs(Number(one.stamp) - Number(state.time)) < 2000);
const kindOf = (/** @type {Finding} */ entry) => (entry.handled ? "handled" : entry.what);

// A mark belongs to the finding that has its object at its frame.
const marks = (/** @type {Finding} */ entry) => (/** @type {HandledFinding} */ mark) => mark.what === entry.what && mark.name === entry.name && entry.sights.some((one) => (
  one.stamp === mark.stamp && one.pick === mark.pick && Math.abs((one.distance ?? 0) - (mark.distance ?? 0)) < 0.5));

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
  const filters = { words: $("find").value, class: $("class").value, reason: $("reason").value, within: $("within").value };
  const shown = [...entries.values()].filter((entry) => (!only || here(entry) >= 0) && matches(entry, filters));
  rows = sorted(shown.filter((entry) => !hidden.has(kindOf(entry))), $("grouped").checked);
  $("found-none").hidden = rows.length > 0;
  $("found-none").textContent = entries.size ? "No finding matches." : "None so far.";
  $("found-title").textContent = `Worth a look: ${rows.length}`;
  kinds(shown);
  let before = "";
  replaceRows(rows.slice(0, SHOWN).flatMap((entry) => {
    const head = $("grouped").checked && cause(entry) !== before;
    before = cause(entry);
    const number = head ? rows.filter((one) => cause(one) === before).length : 0;
    return head ? [element("li", "group", `${before}: ${number}`), drawn(entry)] : [drawn(entry)];
  }));
  requestRemarks();
  does.drawn(rows);
  begin();
}

/**
 * Offer the classes and reasons that the drive has. The chosen one stays.
 * @param {Finding[]} entries
 */
function offerFilters(entries) {
  const objects = entries.filter(hasCause);
  const offer = (/** @type {HTMLSelectElement} */ select, /** @type {string} */ first, /** @type {string[]} */ names) => {
    const options = [...new Set(names)].filter(Boolean).sort();
    if (select.value && !options.includes(select.value)) options.push(select.value);
    if ([...select.options].slice(1).map((one) => one.value).join() === options.join()) return;
    const chosen = select.value;
    select.replaceChildren(new Option(first, ""), ...options.map((name) => new Option(name, name)));
    select.value = chosen;
  };
  offer($("class"), "class", objects.map((entry) => entry.name));
  offer($("reason"), "reason", objects.map(cause));
}

/**
 * Replace the rows that differ. A row that is replaced while a mouse button is down on it misses the click.
 * @param {HTMLLIElement[]} items
 */
function replaceRows(items) {
  const list = $("found");
  for (const [row, item] of items.entries()) {
    const known = /** @type {HTMLElement | undefined} */ (list.children[row]);
    if (!known) list.append(item);
    else if (known.dataset.key !== item.dataset.key || known.outerHTML !== item.outerHTML) known.replaceWith(item);
  }
  while (list.children.length > items.length) list.lastChild?.remove();
}

// Ask for the sentences that the first rows lack. The server answers when it has nothing else to do.
let requested = "";
function requestRemarks() {
  const lacking = rows.slice(0, REMARKED).map((entry) => entry.sights[entry.best])
    .flatMap(({ frame, pick, tried, remark }) => (pick && !tried && !remark && frame !== null ? [{ frame, pick }] : []));
  if (!lacking.length || JSON.stringify(lacking) === requested) return;
  requested = JSON.stringify(lacking);
  does.remarks?.(lacking);
}

/** @param {Finding[]} shown */
function kinds(shown) {
  const counts = new Map();
  for (const entry of shown) counts.set(kindOf(entry), (counts.get(kindOf(entry)) ?? 0) + 1);
  const offered = [...KINDS, "handled"].filter((kind) => counts.has(kind) || (hidden.has(kind) && kind !== "handled"));
  const text = (/** @type {string} */ kind) => `${kind} ${counts.get(kind) ?? 0}`;
  const same = [...$("kinds").children].map((one) => one.textContent).join() === offered.map(text).join();
  if (same) return;
  $("kinds").replaceChildren(...offered.map((kind) => {
    const button = element("button", kind.replace(" ", "-"), text(kind));
    button.ariaPressed = String(!hidden.has(kind));
    button.onclick = () => {
      if (!hidden.delete(kind)) hidden.add(kind);
      button.ariaPressed = String(!hidden.has(kind));
      redraw();
    };
    return button;
  }));
}

/**
 * The span that a note is about.
 * @param {Finding} entry
 */
const spanOf = ({ note }) => (note && note.end !== "0" ? { first: note.stamp, last: note.end } : null);

/** @param {Finding} entry */
function frames(entry) {
  const numbers = entry.sights.map((one) => Number(one.frame));
  if (numbers.length < 2) return "";
  const [low, high] = [Math.min(...numbers), Math.max(...numbers)];
  return high - low + 1 === numbers.length ? `frames ${low}–${high}` : `${numbers.length} frames, ${low}–${high}`;
}

/** @param {Finding} entry */
function drawn(entry) {
  const isChosen = isSubject && entry.key === current;
  const one = entry.sights[isChosen ? Math.min(sight, entry.sights.length - 1) : entry.best];
  const [filled, span, { note, reasons }] = [level(entry), spanOf(entry), entry];
  const dots = element("span", "dots", "●".repeat(filled) + "○".repeat(DOTS - filled));
  dots.title = reasons.join("; ") || "no reason to hurry";
  const [name, away, reason] = [element("span", "name", entry.name), element("span", "away", one.distance === null ? "" : `${one.distance} m`),
    element("span", "reason", one.text)];
  const button = element("button", "", "", dots, element("span", "time", span ? spanText(span) : at(one.stamp, one.frame)),
    element("span", entry.what.replace(" ", "-"), entry.what), name, away, reason);
  reason.title = state.meanings[one.text] ?? one.text;
  button.title = [frames(entry), one.remark].filter((more) => more?.trim()).join("\n");
  if (one.chip) button.append(element("span", `chip ${one.chip.replaceAll(" ", "-")}`, one.chip));
  button.ariaCurrent = String(isChosen);
  button.onclick = () => choose(entry, isChosen ? sight + 1 : entry.best);
  const item = element("li", entry.handled ? "handled" : "", "", button);
  item.dataset.key = String(entry.key);
  if (note) item.append(small("×", "remove this note", () => does.unnote(note)));
  else if (entry.handled) {
    const { state: became, text: why } = entry.handled;
    item.append(element("span", "faint", `${became}${why ? `: ${why}` : ""}`), small("reopen", "list it again", () => mark(entry, "")));
  } else if (isChosen && does.handle && (hasCause(entry) || entry.what === "anomaly") && !one.tried) {
    const why = element("input", "", "");
    why.placeholder = "why (optional)";
    why.ariaLabel = "why it is done or ignored";
    item.append(why, small("done", "it is dealt with", () => mark(entry, "done", why.value)),
      small("ignore", "it is of no concern", () => mark(entry, "ignored", why.value)));
  }
  return item;
}

/**
 * @param {string} text
 * @param {string} meaning
 * @param {() => void} action
 */
function small(text, meaning, action) {
  const button = element("button", "small", text);
  button.title = meaning;
  button.ariaLabel = meaning;
  button.onclick = action;
  return button;
}

/**
 * @param {Finding} entry
 * @param {string} became
 * @param {string} text
 */
function mark(entry, became, text = "") {
  const one = entry.sights[entry.best];
  const known = entry.handled ?? { stamp: one.stamp, what: entry.what, name: entry.name, pick: one.pick, distance: one.distance };
  does.handle?.({ ...known, state: became, text: text.trim() });
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

/** @param {number} by */
export function step(by) {
  if (!rows.length) return;
  const at = rows.findIndex((entry) => entry.key === current);
  const entry = rows[at < 0 && by < 0 ? rows.length - 1 : (at + by + rows.length) % rows.length];
  choose(entry, entry.best);
}

/**
 * @param {Finding} entry
 * @param {number} which index of the sight
 * @param {boolean} scrolls
 */
export function choose(entry, which, scrolls = true) {
  current = entry.key;
  isSubject = true;
  sight = which % entry.sights.length;
  const { stamp, pick, tried } = entry.sights[sight];
  redraw();
  showRow(scrolls);
  if (tried || entry.what.endsWith("gone")) does.tryOut(tried);
  const origin = { time: Number(stamp), set: tried ? does.triedSet() : [] }; // The pick is valid there.
  remember(Boolean(state.pick));
  [state.pick, state.origin] = [pick, origin];
  seek(stamp);
  showSide();
  remember();
  const span = spanOf(entry);
  if (span) does.markSpan(span);
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

/**
 * Scroll the list to the chosen row, and a wide panel to the list.
 * @param {boolean} scrolls
 */
function showRow(scrolls) {
  const list = $("found");
  const item = /** @type {HTMLElement[]} */ ([...list.children]).find((one) => one.dataset.key === String(current));
  if (!item) return;
  const top = item.offsetTop - list.offsetTop;
  if (top < list.scrollTop) list.scrollTop = top;
  else if (top + item.offsetHeight > list.scrollTop + list.clientHeight) list.scrollTop = top + item.offsetHeight - list.clientHeight;
  document.documentElement.style.setProperty("--list-height", `${$("findings").offsetHeight}px`);
  if (!scrolls) return;
  scrollsToAnswer = isNarrow();
  const panel = /** @type {HTMLElement} */ ($("findings").parentElement);
  const above = /** @type {HTMLElement} */ ($("findings").previousElementSibling);
  if (!isNarrow()) panel.scrollTop = Math.min(panel.scrollTop, above.offsetTop);
}
