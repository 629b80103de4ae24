// What is patched for Rerun's web viewer. With a viewer of another version, and where a browser lacks what a patch
// needs, the patch is left out: the page works without it, but more slowly.

import { $ } from "./page_state.js";

const VERSION = "0.41."; // of the viewer that these patches were made for
const isPatched = ($("viewer").dataset.version ?? "").startsWith(VERSION);
export const nextPicture = window.requestAnimationFrame.bind(window);

// --- log ----------------------------------------------------------------------------------------

if (isPatched) console.debug = () => {}; // It logs 50,000 lines at its start, which takes seconds.

// --- start --------------------------------------------------------------------------------------

/**
 * Compile the viewer while it loads, from the start of the page on. Its widget compiles a copy of the response, which
 * counts its bytes: that starts late, blocks this thread, and the browser cannot cache it.
 * @param {string} url of its WebAssembly
 */
export function keepCompiled(url) {
  if (!isPatched || !WebAssembly.compileStreaming) return;
  const { fetch } = window;
  const module = WebAssembly.compileStreaming(fetch(url));
  const address = (/** @type {RequestInfo | URL} */ what) => (what instanceof Request ? what.url : String(what));
  // The viewer looks for a newer one of itself, which the page does not allow.
  const isForeign = (/** @type {string} */ where) => /^https?:/.test(where) && new URL(where).origin !== location.origin;
  window.fetch = (what, ...more) => {
    if (isForeign(address(what))) return Promise.resolve(new Response("{}"));
    return String(what) === url ? Promise.resolve(new Response()) : fetch(what, ...more);
  };
  WebAssembly.compileStreaming = () => module;
}

// --- layout -------------------------------------------------------------------------------------

/**
 * @template M
 * @typedef {{ model: M, el: HTMLElement }} Parts
 */
/** @typedef {Record<string, Record<string, any>>} Blueprint archetypes by entity path */
/** @typedef {{ blueprint: Blueprint, recording: string }} ReadBlueprint */
/** @typedef {{ get_blueprint: () => Promise<ReadBlueprint>, set_blueprint: (blueprint: Blueprint, target: object) => Promise<unknown> }} Viewer */
/** @type {Viewer | null} */
export let viewer = null; // whose layout can be read and set, in a form that Rerun calls experimental

/**
 * Render the widget. Its own function does the same, but keeps the viewer to itself.
 * @template M
 * @param {{ default: { render: (parts: Parts<M>) => void }, ViewerWidget?: new (model: M, el: HTMLElement) => { viewer: Viewer } }} script
 * @param {Parts<M>} parts
 */
export function render({ default: widget, ViewerWidget }, parts) {
  if (!isPatched || !ViewerWidget) {
    widget.render(parts);
    return;
  }
  const container = document.createElement("div");
  parts.el.classList.add("rerun_notebook");
  parts.el.append(container);
  viewer = new ViewerWidget(parts.model, container).viewer;
}

// --- drawing ------------------------------------------------------------------------------------

// The viewer redraws a 3D view or an image all the time, although nothing changes. Without a graphics card that takes
// more than one CPU core. So its pictures are held back while it gets no input and no data, and sends no event.

const AWAKE = 3000; // ms of drawing after the last input, data or event
// Pictures that it may always draw after that. A slow machine takes a second for each, and the viewer needs several to
// read new data: with six it stopped at a picture of another frame.
const PICTURES = 16;
const READ = 200e3; // bytes that it reads for one picture, on a slow machine: it stops reading after 10 ms
const SIGNS = ["pointerdown", "pointermove", "pointerup", "wheel", "keydown", "keyup", "touchstart", "touchmove", "resize",
  "focus", "blur", "dragover", "drop", "paste"];

// Without a graphics card a picture takes a second, after which the viewer reads data for 10 ms. So while it has much to
// read, only one picture in some is drawn: the commands that draw the others are left out.
const DRAWN = 12; // of so many pictures one is drawn
const HELD = 10000; // ms after the pointer was in the viewer in which each picture is drawn: it finds what is there to click
const DRAWING = ["clear", "clearBufferfi", "clearBufferfv", "clearBufferiv", "clearBufferuiv", "drawArrays", "drawArraysInstanced",
  "drawElements", "drawElementsInstanced", "drawRangeElements", "blitFramebuffer"];
const FINISH = 200; // ms after the last picture that was left out until the viewer is asked for one that is drawn
let skipping = false;
let painted = false; // whether the viewer has painted in the present picture
let pictures = 0;
let finish = 0;
let pointed = -HELD;
const drawnInSoftware = () => {
  const gl = document.createElement("canvas").getContext("webgl2");
  const names = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = gl && names ? gl.getParameter(names.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
};
const slow = isPatched && drawnInSoftware();
/** @type {FrameRequestCallback[]} */
const held = [];
let last = performance.now();
let left = PICTURES; // pictures that it may draw without a sign

// A busy machine reads less for each picture. So after the last data the viewer may draw some more, or it could stay at
// the image of an earlier frame under the boxes of the shown one.
const LATE = [3e3, 8e3, 16e3, 32e3]; // ms
const LATE_PICTURES = 60; // Without a graphics card, most of them are left out.
/** @type {number[]} */
let later = [];

// Let the viewer draw for a while, and until it has read these bytes.
export function wake(bytes = 0) {
  last = performance.now();
  release(PICTURES);
  left += Math.ceil(bytes / READ);
  if (!bytes || !isPatched) return;
  for (const timer of later) clearTimeout(timer);
  later = LATE.map((wait) => window.setTimeout(() => release(LATE_PICTURES), wait));
}
/** @param {number} least number of pictures that the viewer may draw */
function release(least) {
  left = Math.max(left, least);
  for (const draw of held.splice(0)) nextPicture(draw);
}

/**
 * Call the viewer for a picture, and count it if it has painted one.
 * @param {FrameRequestCallback} draw
 * @param {number} now
 */
function drawOrSkip(draw, now) {
  painted = false;
  skipping = left > PICTURES && pictures % DRAWN !== 0 && now - pointed > HELD;
  draw(now);
  if (painted) {
    pictures += 1;
    left -= 1;
    clearTimeout(finish);
    if (skipping) finish = window.setTimeout(redraw, FINISH);
  }
  skipping = false;
}

// Ask the viewer, which has read all, for a picture that is drawn.
function redraw() {
  left = Math.min(left, PICTURES);
  wake();
  window.dispatchEvent(new Event("hashchange")); // It repaints then.
}

/** @param {Event} event */
function signed(event) {
  if (event.type.startsWith("pointer") && event.target instanceof Element && event.target.closest("#viewer")) {
    pointed = performance.now();
  }
  wake();
}

if (isPatched) {
  window.requestAnimationFrame = (draw) => {
    if (left <= 0 && performance.now() - last > AWAKE) return held.push(draw) && 0;
    if (!slow) left -= 1;
    return nextPicture(slow ? (now) => drawOrSkip(draw, now) : draw);
  };
  for (const sign of SIGNS) window.addEventListener(sign, signed, { capture: true, passive: true });
  document.addEventListener("visibilitychange", () => wake());
}
if (slow) {
  const commands = /** @type {Record<string, any>} */ (/** @type {unknown} */ (WebGL2RenderingContext.prototype));
  for (const name of DRAWING.filter((one) => one in commands)) {
    const draw = commands[name];
    commands[name] = function (/** @type {unknown[]} */ ...values) {
      painted = true;
      return skipping ? undefined : draw.apply(this, values);
    };
  }
}
