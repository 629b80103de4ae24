// Rerun's viewer: its notebook widget, which keeps its own wrapper of the viewer up to date; this page is its notebook.

import { nextPicture, wake } from "./rest.js";
import { $, asked, state } from "./state.js";

console.debug = () => {}; // the viewer tells it fifty thousand lines at its start, which takes seconds
const version = $("viewer").dataset.version;
export const kind = $("viewer").dataset.kind; // page; native: a window of its own; live: of a robot
if (kind !== "native") keepCompiled(new URL(`/viewer/${version}/re_viewer_bg.wasm`, location.href).href);
const widget = (await import(kind === "native" ? "/page/native.js" : `/viewer/${version}/widget.js`)).default;

// What the run made of a frame, and what other values make of it, are on two timelines of the same recording.
const OPENED = "stamp";
const TRIED = "tried";
const SETTLED = 150; // ms without a change after which a frame is taken for one that is looked at

const listeners = {};
const settings = {
  _url: null, _width: "auto", _height: "auto", _theme: "dark", _fallback_token: null,
  _panel_states: { top: "hidden", blueprint: "hidden", selection: "hidden", time: "collapsed" },
};
const told = { settled: () => {}, clicked: () => {}, shown: () => {}, sought: () => {} }; // whom the viewer's events are for
export const viewerReady = new Promise((ready) => {
  widget.render({
    model: {
      get: (name) => settings[name],
      on: (name, listener) => { listeners[name] = listener; },
      send: (message) => (message === "ready" ? begun(ready) : viewerEvent(JSON.parse(message))),
    },
    el: $("viewer"),
  });
});
function begun(ready) {
  performance.mark("viewer");
  ready();
}
// What is before the viewer now has been drawn when two pictures more have begun.
export const drawnThen = (then) => nextPicture(() => nextPicture(then));
export function toViewer(message, buffers) {
  wake();
  listeners["msg:custom"](message, buffers);
  if (message.type === "rrd" && target !== null) { // which may have what it is on its way to
    tries = TRIES;
    nextPicture(() => { if (target !== null) move(target); });
  }
}
export const tell = (whom) => Object.assign(told, whom);

// The widget compiles a copy of the response, which counts its bytes: late, through this thread, and nothing that a
// browser could keep. This one is compiled as it comes, from the page's first moment on.
function keepCompiled(url) {
  const { fetch } = window;
  const compile = WebAssembly.compileStreaming.bind(WebAssembly);
  const module = compile(fetch(url));
  window.fetch = (what, ...more) => (String(what) === url ? Promise.resolve(new Response()) : fetch(what, ...more));
  WebAssembly.compileStreaming = () => module;
}

window.addEventListener("to-viewer", ({ detail }) => { target = null; toViewer(detail); });

export const isTried = () => kind !== "live" && state.set.length > 0 && !state.flipped; // a robot has one side
const timeline = () => (isTried() ? TRIED : OPENED);
const move = (stamp) => toViewer({ type: "time_ctrl", timeline: timeline(), timestamp_nanos: stamp, play: false });

// A viewer that has just opened a recording goes to its beginning of itself, and takes no time before that.
// One that is opened again with other values has their timeline only when the first of them has come.
const TRIES = 3; // before there is something new
let target = null; // stamp that the viewer is to show, until somebody moves it
let tries = 0;
let current = null; // timeline
for (const sign of ["pointerdown", "keydown", "wheel"]) {
  window.addEventListener(sign, (event) => { if ($("viewer").contains(event.target)) target = null; }, true);
}
export function seek(stamp) {
  target = String(stamp);
  tries = TRIES;
  state.time = target;
  told.sought(target);
  move(target);
}

// The same time with the other values, or without.
export const showSide = () => { if (kind !== "live" && state.time !== null) seek(state.time); };

window.addEventListener("pointerup", () => { asked.released = performance.now(); }, true);

let drawn = false; // whether a frame has been on the screen
let settling = 0;
function viewerEvent(event) {
  wake();
  window.dispatchEvent(new CustomEvent("viewer-event", { detail: event }));
  if (event.type === "recording_open" && state.time !== null) seek(state.time); // somebody may have chosen another one
  if (event.type === "time_update" || event.type === "timeline_change") moved(event);
  if (event.type === "selection_change") {
    const item = event.items.find((one) => one.type === "entity");
    if (item) {
      told.clicked({ entity: item.entity_path, instance: item.instance_id ?? null, position: item.position ?? null });
    }
  }
}

function moved(event) {
  if (event.type === "timeline_change") current = event.timeline;
  const there = Number(target) === event.time && (current ?? timeline()) === timeline();
  if (there && kind === "native") target = null; // whose own slider is not seen here
  if (target !== null && !there && event.type === "time_update") { // late, of where it was before
    if (tries > 0) move(target);
    tries -= 1;
    return;
  }
  if (!drawn) {
    drawn = true;
    performance.mark("told");
    drawnThen(() => { performance.mark("frame"); told.shown(); });
  }
  if (event.type !== "time_update" || (state.time !== null && Number(state.time) === event.time)) return;
  state.time = String(BigInt(Math.round(event.time)));
  clearTimeout(settling);
  settling = setTimeout(told.settled, SETTLED);
}
