// Panel of a running robot: go back, hold a frame, follow the newest one, save the flight recorder, mark a frame.

import { on, send } from "./connection.js";
import { $, dropFrames, frameTimes, state } from "./page_state.js";
import { goTo, seek } from "./viewer.js";

$("robot").hidden = false;
for (const id of /** @type {const} */ (["drive", "flip", "note"])) $(id).hidden = true; // These need a recorded drive.

/** @import { Problem, Progress } from "./types" */

/** @type {number | null} */
let time = null; // of the viewer, nanoseconds
/** @type {number | null} */
let newest = null;
window.addEventListener("viewer-event", (event) => {
  const { detail } = /** @type {CustomEvent} */ (event);
  if (detail.type === "time_update") time = detail.time;
  if (time !== null && (newest === null || time > newest)) newest = time;
});

/**
 * @param {string} text
 * @param {boolean} [wrong]
 */
function say(text, wrong) {
  $("said").textContent = text;
  $("said").className = wrong ? "alarm" : "faint";
}

const command = (/** @type {import("./connection.js").Sent} */ message) => send(message, ({ text }) => say(text, true));

// The slider has one step for each frame of the held seconds, which go on. While it is held, they stay.
/** @type {number[] | null} */
let sliding = null; // times of the frames when the slider was taken
const ago = (/** @type {number[]} */ times, /** @type {number} */ row) => `${((times[times.length - 1] - times[row]) / 1e9).toFixed(1)} s ago`;

/** @param {Progress} message */
export function progress({ held = [], problems = [] }) {
  showProblems(problems);
  if (held.length) dropFrames(held);
  const times = frameTimes();
  $("past").disabled = times.length < 2;
  if (sliding || times.length < 2) return;
  const at = time ?? newest ?? 0;
  const row = frameTimes.row(at);
  const shown = times[row] < state.start && at > times[row] + 1000 ? -1 : row;
  $("past").max = String(times.length - 1);
  $("past").value = String(Math.max(shown, 0));
  const gone = time === null ? "" : "longer ago than is held"; // The viewer has drawn nothing yet.
  $("past-at").textContent = shown < 0 ? gone : ago(times, shown);
}
$("past").oninput = () => {
  sliding ??= frameTimes();
  const row = Math.min(Number($("past").value), sliding.length - 1);
  $("past-at").textContent = ago(sliding, row);
  goTo(String(BigInt(sliding[row])), false);
};
$("past").onchange = () => {
  if (!sliding) return;
  const wanted = sliding[Math.min(Number($("past").value), sliding.length - 1)];
  sliding = null;
  say("Holding the frame ...");
  command({ type: "hold", time: wanted });
};

// Show the problems of the robot's data now, and how long they have lasted.
/** @param {Problem[]} problems */
function showProblems(problems) {
  $("problems").hidden = !problems.length;
  $("problems").replaceChildren(...problems.map(({ text, seconds }) => {
    const row = document.createElement("li");
    row.textContent = `${text} (for ${seconds} s)`;
    return row;
  }));
}

function mark() {
  if (time !== null) command({ type: "mark", time, text: $("mark-text").value });
  $("mark-text").value = "";
}

on({
  held: (message) => {
    say(`Frame ${message.frame} is held: ask about it.`);
    seek(message.stamp); // The viewer may get the frame only after this message.
  },
  said: (message) => say(message.text),
  gone: () => say("No connection to the robot: the last frame that came is shown.", true),
});

// What the keys of these buttons do.
export const actions = {
  h: () => { if (time !== null) command({ type: "hold", time }); },
  f: () => { say("At the newest frame."); if (newest !== null) goTo(String(BigInt(Math.round(newest))), true); },
  l: () => { say("Listing ..."); command({ type: "list" }); },
  s: () => { say("Saving ..."); command({ type: "snap" }); },
  m: mark,
};
for (const [id, key] of /** @type {const} */ ([["hold", "h"], ["follow", "f"], ["list", "l"], ["snap", "s"], ["mark", "m"]])) $(id).onclick = actions[key];
$("mark-text").onkeydown = (event) => { if (event.key === "Enter") mark(); };
