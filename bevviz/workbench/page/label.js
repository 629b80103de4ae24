// Label of an object, which the user draws by numbers and keeps as truth beside the bag. The server shows it in the views.

import { send } from "./connection.js";
import { $, element, state } from "./page_state.js";

/** @import { Label, LabelBox } from "./types" */

const PAUSE = 200; // ms after a change until the picture follows
const CENTER = { x: "metres ahead of the sensor", y: "metres to the left", z: "metres above the sensor" };
const SIZE = { length: "metres", width: "metres", height: "metres" };
const NUMBERS = { ...CENTER, ...SIZE, yaw: "degrees to the left" };

/** @type {Map<string, HTMLInputElement>} */
const fields = new Map();
let drawing = 0; // number of the newest message
let about = { time: 0, pick: "" }; // object of the form
let waiting = 0;
let isKept = false; // The text says where, beside the next answer.

/** @param {() => void} cancelled shows the answer again */
export function start(cancelled) {
  for (const [name, meaning] of Object.entries(NUMBERS)) {
    const input = Object.assign(element("input", "", ""), { type: "number", step: name === "yaw" ? "1" : "0.05", required: true, title: meaning });
    if (name in SIZE) input.min = input.step;
    fields.set(name, input);
    $("label-numbers").append(element("label", "", `${name} `, input));
  }
  $("label").noValidate = true; // A step is for the arrow keys alone.
  $("label").oninput = () => {
    clearTimeout(waiting);
    waiting = window.setTimeout(draw, PAUSE, false);
  };
  $("label").onsubmit = (event) => {
    event.preventDefault();
    clearTimeout(waiting);
    draw(true);
  };
  $("label-cancel").onclick = () => { close(); cancelled(); };
}

// Begin with the box that is kept, or that the object seems to have.
export function open() {
  about = { time: Number(state.time), pick: state.pick };
  for (const input of fields.values()) input.value = "";
  $("label-text").textContent = "Looking for its points ...";
  $("label").hidden = false;
  ask({});
}

export function close() {
  clearTimeout(waiting);
  drawing = 0;
  $("label").hidden = true;
  if (!isKept) $("label-text").textContent = "";
  isKept = false;
}

/** @param {boolean} keep */
function draw(keep) {
  const numbers = (/** @type {Record<string, string>} */ group) => Object.keys(group).map((name) => fields.get(name)?.valueAsNumber ?? NaN);
  const [center, size, [yaw]] = [numbers(CENTER), numbers(SIZE), numbers({ yaw: "" })];
  if ([...center, ...size, yaw].some(Number.isNaN)) $("label-text").textContent = "Each field needs a number.";
  else ask({ box: { label: $("label-class").value, center, size, yaw }, keep });
}

/** @param {{ box?: LabelBox, keep?: boolean }} what */
function ask(what) {
  drawing = send({ type: "draw", ...about, ...what }, ({ id, text }) => { if (id === drawing) $("label-text").textContent = text; });
}

/** @param {Label} message */
export function drawn(message) {
  if (message.id !== drawing) return;
  const { label, center, size, yaw } = message.box;
  const isFirst = [...fields.values()].every((input) => !input.value);
  if (isFirst) { // Later the numbers are the user's.
    $("label-class").value = label;
    for (const [row, input] of [...fields.values()].entries()) input.value = String([...center, ...size, yaw][row]);
    $("label-classes").replaceChildren(...message.classes.map((name) => new Option(name)));
  }
  isKept = Boolean(message.kept);
  if (isKept && state.pick === about.pick) state.pick = message.pick;
  $("label-text").textContent = message.kept || `${message.points} points in it.`;
}
