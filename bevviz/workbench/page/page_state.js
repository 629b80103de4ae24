// State of the page. The address holds it, so that the same address shows the same again.

export const $ = (id) => document.getElementById(id);

export const state = {
  bag: "", run: "", meanings: {}, // texts of the reasons, of what other values change, and of F1
  truth: false, // whether there is ground truth
  single: false, // whether the frames are unrelated
  time: null, pick: "", origin: null, set: [], undo: [], redo: [], flipped: false,
  opening: null, // stamp of the frame that is shown first
  over: false, // the server has all frames
  first: 0, // stamp that seconds are counted from
  start: 0, // stamp that the held seconds of a robot begin with; frames before it were held by hand
  demand: false, // whether the viewer gets a frame only when it is looked at
  answer: null, // frame and settings of the shown answer
  span: null, // first and last stamp of the marked span, as text
};
const frames = []; // time, number and stamp (the same as text) of each frame that the server has, sorted
export function addFrames(message) {
  frames.push(...message.frames.map(({ stamp, frame }) => ({ time: Number(stamp), number: frame, stamp })));
  frames.sort((a, b) => a.time - b.time || a.number - b.number);
}
// Forget the frames that the server of a robot has no longer: all before the last of these stamps, but the others.
export function dropFrames(held) {
  state.start = Number(held.at(-1));
  const rest = frames.filter(({ time, stamp }) => time >= state.start || held.includes(stamp));
  frames.splice(0, frames.length, ...rest);
}
export const frameTimes = () => frames.map(({ time }) => time); // sorted
frameTimes.stamp = (row) => frames[row].stamp;
frameTimes.number = (row) => frames[row].number;
const TOLERANCE = 1000; // ns, of the times of a viewer
const rowAt = (time) => frames.findLastIndex((frame) => frame.time <= Number(time) + TOLERANCE);
// Frames come in any order: the one that is shown first, then all. So the next one in the list need not be the next frame.
const follows = (row, by) => state.over || frames[row + by]?.number === frames[row]?.number + by;

// Number of the shown frame. null: the server does not have it yet.
export function shownFrame() {
  const row = rowAt(state.time);
  const isAlone = row >= 0 && (frames[row].time < state.start || !follows(row, 1));
  const isKnown = row >= 0 && (!isAlone || Number(state.time) - frames[row].time <= TOLERANCE);
  return isKnown ? frames[row].number : null;
}

// Stamp of the next frame or the one before. null: there is none, or the server does not have it yet.
export function neighbour(by) {
  const row = rowAt(state.time);
  return shownFrame() !== null && follows(row, by) ? frames[row + by]?.stamp ?? null : null;
}

// Times in ms: the pointer was released, the newest question began for the user, and it was sent.
export const asked = { released: 0, at: 0, sent: 0 };
export const stated = new URLSearchParams(location.hash.slice(1));

// What a user has chosen for all drives, which this browser keeps.
export function kept(name, otherwise) {
  try { return JSON.parse(localStorage.getItem(`bevviz.${name}`)) ?? otherwise; } catch { return otherwise; }
}
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

export const seconds = (stamp) => (
  state.opening === null ? "" : `${((Number(stamp) - Number(state.first)) / 1e9).toFixed(2)} s`);

// When a frame is, for the user: single frames have made up times.
export const at = (stamp, frame) => (state.single ? `frame ${frame ?? frames[rowAt(stamp)]?.number}` : seconds(stamp));

// Whether a stamp is in the marked span. Without one, all are.
export const inSpan = (stamp) => !state.span
  || (Number(stamp) >= Number(state.span.first) - TOLERANCE && Number(stamp) <= Number(state.span.last) + TOLERANCE);
export const spanText = ({ first, last }) => (state.single ? `${at(first)} to ${at(last)}` : `${at(first).replace(" s", "")} to ${at(last)}`);

// A number before and after a change.
export const beforeAfter = ({ before, after }) => `${before ?? "–"} → ${after ?? "–"}`;

export function element(name, className, text, ...children) {
  const made = document.createElement(name);
  if (className) made.className = className;
  if (text) made.textContent = text;
  made.append(...children);
  return made;
}
