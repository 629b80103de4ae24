// State of the page. The address holds it, so that the same address shows the same again.

export const $ = (id) => document.getElementById(id);

export const state = {
  bag: "", run: "", time: null, pick: "", set: [], undo: [], flipped: false,
  opening: null, // stamp of the frame that is shown first
  first: 0, // stamp that seconds are counted from
  answer: null, // frame and settings of the shown answer
};
const frames = []; // stamp and number of each frame that the server has, sorted
export function addFrames(message) {
  frames.push(...message.frames.map(([stamp, number]) => [Number(stamp), number, stamp]));
  frames.sort((a, b) => a[0] - b[0] || a[1] - b[1]);
}
const rowAt = (time) => frames.findLastIndex(([stamp]) => stamp <= Number(time) + 1000);
export const shownFrame = () => frames[rowAt(state.time)]?.[1] ?? null; // number
export const neighbour = (by) => frames[rowAt(state.time) + by]?.[2] ?? null; // stamp

// Times in ms: the pointer was released, the newest question began for the user, and it was sent.
export const asked = { released: 0, at: 0, sent: 0 };
export const stated = new URLSearchParams(location.hash.slice(1));

export function remember() {
  const parts = new URLSearchParams({ bag: state.bag });
  if (state.time !== null) parts.set("at", state.time);
  if (state.pick) parts.set("pick", state.pick);
  for (const one of state.set) parts.append("set", one);
  if (state.set.length && state.flipped) parts.set("side", "before");
  history.replaceState(null, "", `${location.pathname}${location.search}#${parts}`);
}

export const seconds = (stamp) => (
  state.opening === null ? "" : `${((Number(stamp) - Number(state.first)) / 1e9).toFixed(2)} s`);

export function element(name, className, text, ...children) {
  const made = document.createElement(name);
  if (className) made.className = className;
  if (text) made.textContent = text;
  made.append(...children);
  return made;
}
