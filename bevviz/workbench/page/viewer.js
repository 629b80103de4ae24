// Rerun's viewer, as its notebook widget. The widget wraps the viewer of its version; this page acts as the notebook.

import { $, asked, element, shownFrame, state } from "./page_state.js";
import { keepCompiled, nextPicture, render, wake } from "./rerun_patches.js";

/** @typedef {{ entity: string, instance: number | null, position: number[] | null, view: string }} Click */
/** @typedef {{ type: "rrd" } | { type: "time_ctrl", timeline: string, timestamp_nanos: string | null, play: boolean }} Command */
/** @typedef {(message: Command, buffers?: DataView[]) => void} Listener */
/** @typedef {{ get: (name: string) => unknown, on: (name: string, listener: Listener) => void, send: (message: string) => void }} Model */
/** @typedef {import("./rerun_patches.js").Parts<Model>} Parts */
/** @typedef {{ render: (parts: Parts) => void }} Widget */
/** @typedef {{ type: string, timeline?: string, time?: number, items: Record<string, any>[] }} ViewerEvent */

const version = $("viewer").dataset.version;
export const kind = $("viewer").dataset.kind; // page (of a drive) or live (of a robot)
const hasGraphics = Boolean(document.createElement("canvas").getContext("webgl2"));
if (hasGraphics) keepCompiled(new URL(`/viewer/${version}/re_viewer_bg.wasm`, location.href).href);
/** @type {{ default: Widget }} */
const script = hasGraphics ? await import(`/viewer/${version}/exported_widget.js`) : { default: cameraOnly() };

// Results of the run and results with other values are on two timelines of the same recording.
const OPENED = "stamp";
const TRIED = "tried";
const SETTLED = 150; // ms without a change of time, after which the user is looking at the frame

/** @type {Record<string, Listener>} */
const listeners = {};
/** @type {Record<string, unknown>} */
const settings = {
  _url: null, _width: "auto", _height: "auto", _theme: "dark", _fallback_token: null,
  // The time bar of a drive is the page's: the viewer's loses its buttons in a narrow view.
  _panel_states: { top: "hidden", blueprint: "hidden", selection: "hidden", time: kind === "live" ? "collapsed" : "hidden" },
};
/** @typedef {"settled" | "shown" | "moved"} Moment */
/** @typedef {Record<Moment, () => void> & { clicked: (click: Click) => void, sought: (stamp: string) => void }} Callbacks */
/** @type {Callbacks} */
const callbacks = { settled: () => {}, clicked: () => {}, shown: () => {}, sought: () => {}, moved: () => {} }; // for its events
/** @type {Promise<void>} */
export const viewerReady = new Promise((ready) => {
  render(script, {
    model: {
      get: (name) => settings[name],
      on: (name, listener) => { listeners[name] = listener; },
      send: (message) => (message === "ready" ? begun(ready) : viewerEvent(JSON.parse(message))),
    },
    el: $("viewer"),
  });
});

/**
 * Without WebGL Rerun's viewer draws nothing. Show the camera of the frame instead, and go at once where the page goes.
 * @returns {Widget}
 */
function cameraOnly() {
  const [text, image] = [document.createElement("p"), new Image()];
  text.textContent = "This browser has no WebGL, so there are no views in space. The camera is shown, and the list answers.";
  image.alt = "camera of the frame";
  const missing = element("p", "faint", "There is no image of this frame.");
  const tell = (/** @type {boolean} */ isShown) => () => { [image.hidden, missing.hidden] = [!isShown, isShown]; };
  [image.onload, image.onerror] = [tell(true), tell(false)];
  tell(true)();
  const show = () => { const frame = shownFrame(); if (frame !== null) image.src = `/thumbnail/${frame}`; };
  return { render: ({ model, el }) => {
    const figure = Object.assign(document.createElement("figure"), { id: "no-graphics" });
    figure.append(text, image, missing);
    el.append(figure);
    model.on("msg:custom", (message) => {
      if (message.type !== "time_ctrl") return;
      setTimeout(() => {
        model.send(JSON.stringify({ type: "timeline_change", timeline: message.timeline, time: Number(message.timestamp_nanos) }));
        show();
      });
    });
    setTimeout(() => {
      model.send("ready");
      model.send(JSON.stringify({ type: "timeline_change", timeline: OPENED }));
    });
  } };
}

/** @param {() => void} ready */
function begun(ready) {
  performance.mark("viewer");
  ready();
}
// The viewer has drawn its current data once two more pictures have begun.
const drawnThen = (/** @type {() => void} */ then) => nextPicture(() => nextPicture(then));
/**
 * @param {Command} message
 * @param {DataView[]} [buffers]
 */
export function toViewer(message, buffers) {
  wake(buffers?.[0].byteLength);
  listeners["msg:custom"](message, buffers);
  if (message.type === "rrd" && isAway()) { // It may hold the frame that the viewer has to go to.
    tries = TRIES;
    nextPicture(approach);
  }
}
export const onViewer = (/** @type {Partial<Callbacks>} */ more) => Object.assign(callbacks, more);

export const isTried = () => kind !== "live" && state.set.length > 0 && !state.flipped; // A robot has no tried side.
const timeline = () => (isTried() ? TRIED : OPENED);
const move = (/** @type {string | null} */ stamp) => hasTimes && toViewer({ type: "time_ctrl", timeline: timeline(), timestamp_nanos: stamp, play: false });

// A viewer that opens a recording goes to its start by itself, and ignores any time before that.
// A page that is reopened with other values gets their timeline only with the first tried result.
// The viewer goes to one time after another, each with a picture. So it is sent nowhere twice while it draws.
const TRIES = 12; // attempts until new data arrives
const AGAIN = 1500; // ms until the second attempt
const LONGER = 1.2; // times longer until each further one, as a viewer that still reads its data is slow
/** @type {string | null} */
let target = null; // stamp that the viewer has to show, until the user moves it
let tries = 0;
let trying = 0;
let hasTimes = false; // The viewer has told a time. It cannot go to one before.
/** @type {string | null} */
let current = null; // timeline of the viewer
/** @type {number | null} */
let at = null; // time of the viewer
const isAway = () => target !== null && (at !== Number(target) || (current ?? timeline()) !== timeline());
export const isThere = () => !isAway();
function approach() {
  if (!isAway() || tries === 0) return;
  tries -= 1;
  move(target);
  wait();
}
function wait() {
  clearTimeout(trying);
  trying = window.setTimeout(() => drawnThen(approach), AGAIN * LONGER ** (TRIES - tries));
}
for (const sign of ["pointerdown", "keydown", "wheel"]) {
  window.addEventListener(sign, (event) => { if ($("viewer").contains(/** @type {Node} */ (event.target))) target = null; }, true);
}
/** @param {string} stamp */
export function seek(stamp) {
  target = String(stamp);
  tries = TRIES;
  state.time = target;
  callbacks.sought(target);
  move(target);
  wait();
  settle();
}

/**
 * Go to a stamp once. The user may move on from it, or the viewer plays from it.
 * @param {string} stamp
 * @param {boolean} play
 */
export function goTo(stamp, play) {
  target = null;
  toViewer({ type: "time_ctrl", timeline: OPENED, timestamp_nanos: stamp, play });
}

let isPlaying = false;
export function playOrPause() {
  target = null;
  toViewer({ type: "time_ctrl", timeline: timeline(), timestamp_nanos: state.time, play: !isPlaying });
}

// Show the same time on the chosen side, as opened or as tried.
export const showSide = () => { if (kind !== "live" && state.time !== null) seek(state.time); };

window.addEventListener("pointerup", () => { asked.released = performance.now(); }, true);

let drawn = false; // whether a frame has been drawn
let settling = 0;
/** @param {ViewerEvent} event */
function viewerEvent(event) {
  wake();
  window.dispatchEvent(new CustomEvent("viewer-event", { detail: event }));
  if (event.type === "recording_open" && state.time !== null) seek(state.time); // The user may have chosen another.
  if (event.type === "play" || event.type === "pause") isPlaying = event.type === "play";
  if (event.type === "time_update" || event.type === "timeline_change") moved(event);
  if (event.type === "selection_change") {
    const item = event.items.find((one) => one.type === "entity");
    if (item) {
      const { entity_path: entity, instance_id: instance = null, position = null, view_name: view = "" } = item;
      callbacks.clicked({ entity, instance, position, view });
    }
  }
}

/** @param {ViewerEvent} event */
function moved(event) {
  if (event.type === "timeline_change") current = event.timeline ?? null;
  at = event.time ?? at;
  if (!hasTimes) {
    hasTimes = true;
    if (target !== null) move(target);
  }
  if (isAway() && event.type === "time_update") return; // a late event about the previous time
  if (!drawn) {
    drawn = true;
    performance.mark("told");
    drawnThen(() => { performance.mark("frame"); callbacks.shown(); });
  }
  if (event.type !== "time_update" || event.time === undefined || (state.time !== null && Number(state.time) === event.time)) return;
  state.time = String(BigInt(Math.round(event.time)));
  settle();
}

function settle() {
  callbacks.moved();
  clearTimeout(settling);
  settling = window.setTimeout(callbacks.settled, SETTLED);
}
