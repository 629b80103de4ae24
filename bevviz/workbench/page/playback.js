// Playback of a drive: the page shows one frame after another, at a speed, in a loop, within the marked span.

import { $, at, frameTimes, inSpan, kept, keep, shownFrame, state } from "./page_state.js";
import { isThere, seek } from "./viewer.js";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
const AGAIN = 30; // ms until it is asked again whether the viewer shows the frame

/** @type {ReturnType<typeof setTimeout> | 0} */
let timer = 0; // 0: paused
let begun = { wall: 0, stamp: 0 }; // when and where the playback began
/** @type {string | null} */
let shown = null; // stamp that it has sought last
let loops = Boolean(kept("loop", false));

export function start() {
  $("speed").replaceChildren(...SPEEDS.map((speed) => new Option(`${speed} ×`, String(speed))));
  $("speed").value = String(kept("speed", 1));
  $("speed").onchange = changeSpeed;
  $("play").onclick = toggle;
  $("loop").onclick = toggleLoop;
  tell();
}

function tell() {
  $("play").textContent = timer ? "❚❚" : "▶";
  $("play").ariaLabel = timer ? "pause" : "play";
  $("loop").ariaPressed = String(loops);
}

// Tell time and frame of the shown frame beside the buttons.
export function tellTime() {
  const times = frameTimes();
  $("transport").hidden = times.length < 2;
  if (times.length < 2) return;
  const [frame, last] = [shownFrame(), frameTimes.stamp(times.length - 1)];
  const number = frame === null ? "" : `frame ${frame}`;
  $("clock").textContent = state.single ? number : `${at(state.time)} of ${at(last)} · ${number}`;
}

// Rows of the frames that are played.
function range() {
  const rows = frameTimes().map((stamp, row) => (inSpan(stamp) ? row : -1)).filter((row) => row >= 0);
  return [rows[0] ?? 0, rows.at(-1) ?? 0];
}

export function toggle() {
  if (timer) { pause(); return; }
  const [first, last] = range();
  const row = frameTimes.row(state.time);
  if (frameTimes().length < 2) return;
  go(row < first || row >= last ? first : row);
  timer = setTimeout(tick, AGAIN);
  tell();
}

export function pause() {
  clearTimeout(timer);
  timer = 0;
  tell();
}

export function toggleLoop() {
  loops = !loops;
  keep("loop", loops);
  tell();
}

function changeSpeed() {
  keep("speed", Number($("speed").value));
  rebase();
}

/** @param {number} by */
export function faster(by) {
  $("speed").selectedIndex = Math.min(SPEEDS.length - 1, Math.max(0, $("speed").selectedIndex + by));
  changeSpeed();
}

/** @param {number} row */
function go(row) {
  shown = frameTimes.stamp(row);
  seek(shown);
  rebase();
}

function rebase() {
  begun = { wall: performance.now(), stamp: Number(state.time) };
}

// Show the frame that is due once the viewer shows the last one. A slow viewer leaves frames out, and keeps the speed.
function tick() {
  if (state.time !== shown) { pause(); return; } // The user has gone elsewhere.
  timer = setTimeout(tick, AGAIN);
  const [first, last] = range();
  const row = frameTimes.row(shown);
  if (!isThere()) return;
  if (row >= last) {
    if (loops) go(first);
    else pause();
    return;
  }
  const due = begun.stamp + (performance.now() - begun.wall) * 1e6 * Number($("speed").value);
  const next = Math.min(frameTimes.row(due), last);
  if (next <= row) return;
  shown = frameTimes.stamp(next);
  seek(shown);
}
