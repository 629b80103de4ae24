// What the page is at. The address holds it: opened again, it shows the same.

export const $ = (id) => document.getElementById(id);

export const state = {
  bag: "", run: "", time: null, pick: "", place: "", set: [], undo: [], flipped: false,
  opening: null, // stamp that is shown first
  first: 0, // stamp that times count from
};
export const asked = { released: 0, at: 0 }; // when the pointer was let go, and when the newest question was asked
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
