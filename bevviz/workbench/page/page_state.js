// State of the page. The address holds it, so that the same address shows the same again.

/** @import { BeforeAfter, Elements, Frames, Origin, Span } from "./types" */

/**
 * An element of index.html by its id.
 * @template {keyof Elements} K
 * @param {K} id
 */
export const $ = (id) => /** @type {Elements[K]} */ (document.getElementById(id));

/**
 * @typedef {object} State
 * @property {string} bag
 * @property {string} run
 * @property {Record<string, string>} meanings texts of the reasons, of what other values change, and of F1
 * @property {boolean} truth whether there is ground truth
 * @property {boolean} single whether the frames are unrelated
 * @property {string | null} time
 * @property {string} pick
 * @property {Origin | null} origin
 * @property {string[]} set
 * @property {string[][]} undo
 * @property {string[][]} redo
 * @property {boolean} flipped
 * @property {string | null} opening stamp of the frame that is shown first
 * @property {boolean} over the server has all frames
 * @property {number | string} first stamp that seconds are counted from
 * @property {number} start stamp that the held seconds of a robot begin with; frames before it were held by hand
 * @property {boolean} demand whether the viewer gets a frame only when it is looked at
 * @property {{ id: number, frame: number, set: string[] } | null} answer frame and settings of the shown answer
 * @property {Span | null} span the marked span
 */

/** @type {State} */
export const state = {
  bag: "", run: "", meanings: {}, truth: false, single: false,
  time: null, pick: "", origin: null, set: [], undo: [], redo: [], flipped: false,
  opening: null, over: false, first: 0, start: 0, demand: false, answer: null, span: null,
};
/** @type {{ time: number, number: number, stamp: string }[]} */
const frames = []; // those that the server has, sorted; a stamp is the time as text

/** @param {Frames} message */
export function addFrames(message) {
  frames.push(...message.frames.map(({ stamp, frame }) => ({ time: Number(stamp), number: frame, stamp })));
  frames.sort((a, b) => a.time - b.time || a.number - b.number);
}
/**
 * Forget the frames that the server of a robot has no longer: all before the last of these stamps, but the others.
 * @param {string[]} held
 */
export function dropFrames(held) {
  state.start = Number(held.at(-1));
  const rest = frames.filter(({ time, stamp }) => time >= state.start || held.includes(stamp));
  frames.splice(0, frames.length, ...rest);
}
export const frameTimes = () => frames.map(({ time }) => time); // sorted
frameTimes.stamp = (/** @type {number} */ row) => frames[row].stamp;
frameTimes.number = (/** @type {number} */ row) => frames[row].number;
const TOLERANCE = 1000; // ns, of the times of a viewer
frameTimes.row = (/** @type {string | number | null} */ time) => frames.findLastIndex((frame) => frame.time <= Number(time) + TOLERANCE);
// Frames come in any order: the one that is shown first, then all. So the next one in the list need not be the next frame.
const follows = (/** @type {number} */ row, /** @type {number} */ by) => state.over || frames[row + by]?.number === frames[row]?.number + by;

/** Number of the shown frame. null: the server does not have it yet. */
export function shownFrame() {
  const row = frameTimes.row(state.time);
  const isAlone = row >= 0 && (frames[row].time < state.start || !follows(row, 1));
  const isKnown = row >= 0 && (!isAlone || Number(state.time) - frames[row].time <= TOLERANCE);
  return isKnown ? frames[row].number : null;
}

/**
 * Stamp of the next frame or the one before. null: there is none, or the server does not have it yet.
 * @param {number} by
 */
export function neighbour(by) {
  const row = frameTimes.row(state.time);
  return shownFrame() !== null && follows(row, by) ? frames[row + by]?.stamp ?? null : null;
}

// Times in ms: the pointer was released, the newest question began for the user, and it was sent.
export const asked = { released: 0, at: 0, sent: 0 };
export const stated = new URLSearchParams(location.hash.slice(1));

/**
 * What a user has chosen for all drives, which this browser keeps.
 * @param {string} name
 * @param {unknown} otherwise
 */
export function kept(name, otherwise) {
  try { return JSON.parse(localStorage.getItem(`bevviz.${name}`) ?? "null") ?? otherwise; } catch { return otherwise; }
}
/**
 * @param {string} name
 * @param {unknown} value
 */
export function keep(name, value) {
  try { localStorage.setItem(`bevviz.${name}`, JSON.stringify(value)); } catch { /* The browser keeps nothing. */ }
}

// Keep the state in the address. A new subject is a new step of the browser's history.
export function remember(isNew = false) {
  const parts = new URLSearchParams({ bag: state.bag });
  if (state.time !== null) parts.set("at", state.time);
  if (state.pick) parts.set("pick", state.pick);
  if (state.span) parts.set("span", `${state.span.first}-${state.span.last}`);
  for (const one of state.set) parts.append("set", one);
  if (state.set.length && state.flipped) parts.set("side", "before");
  const address = `${location.pathname}${location.search}#${parts}`;
  if (isNew) history.pushState({ own: true }, "", address);
  else history.replaceState({ own: true }, "", address);
}

export const seconds = (/** @type {string | number | null} */ stamp) => (
  state.opening === null ? "" : `${((Number(stamp) - Number(state.first)) / 1e9).toFixed(2)} s`);

/**
 * When a frame is, for the user: single frames have made up times.
 * @param {string | null} stamp
 * @param {number | null} [frame]
 */
export const at = (stamp, frame) => (state.single ? `frame ${frame ?? frames[frameTimes.row(stamp)]?.number}` : seconds(stamp));

// Whether a stamp is in the marked span. Without one, all are.
export const inSpan = (/** @type {string | number | null} */ stamp) => !state.span
  || (Number(stamp) >= Number(state.span.first) - TOLERANCE && Number(stamp) <= Number(state.span.last) + TOLERANCE);
/** @param {Span} span */
export const spanText = ({ first, last }) => (state.single ? `${at(first)} to ${at(last)}` : `${at(first).replace(" s", "")} to ${at(last)}`);

/**
 * A number before and after a change.
 * @param {BeforeAfter} numbers
 */
export const beforeAfter = ({ before, after }) => `${before ?? "–"} → ${after ?? "–"}`;

/**
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} name
 * @param {string} className
 * @param {string} text
 * @param {(Node | string)[]} children
 */
export function element(name, className, text, ...children) {
  const made = document.createElement(name);
  if (className) made.className = className;
  if (text) made.textContent = text;
  made.append(...children);
  return made;
}
