// Panel of a running robot: hold a frame, follow the newest one, save the flight recorder, mark a frame.

import { on, send } from "./connection.js";
import { $ } from "./page_state.js";
import { goTo } from "./viewer.js";

$("robot").hidden = false;
for (const id of ["drive", "flip"]) $(id).hidden = true; // These need a recorded drive.
$("words").closest("section").hidden = true;

let time = null; // of the viewer, nanoseconds
let newest = null;
window.addEventListener("viewer-event", ({ detail }) => {
  if (detail.type === "time_update") time = detail.time;
  if (time !== null && (newest === null || time > newest)) newest = time;
});

function say(text, wrong) {
  $("said").textContent = text;
  $("said").className = wrong ? "alarm" : "faint";
}

function mark() {
  if (time !== null) send({ type: "mark", time, text: $("mark-text").value });
  $("mark-text").value = "";
}

on({
  held: (message) => {
    say(`Frame ${message.frame} is held: ask about it.`);
    goTo(message.stamp, false);
  },
  said: (message) => say(message.text, message.wrong),
  gone: () => say("No connection to the robot: the last frame that came is shown.", true),
});

// What the keys of these buttons do.
export const actions = {
  h: () => { if (time !== null) send({ type: "hold", time }); },
  f: () => { say("At the newest frame."); if (newest !== null) goTo(String(BigInt(Math.round(newest))), true); },
  s: () => { say("Saving ..."); send({ type: "snap" }); },
  m: mark,
};
for (const [id, key] of [["hold", "h"], ["follow", "f"], ["snap", "s"], ["mark", "m"]]) $(id).onclick = actions[key];
$("mark-text").onkeydown = (event) => { if (event.key === "Enter") mark(); };
