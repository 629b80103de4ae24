// The viewer (Rerun 0.41) redraws a 3D view or an image all the time, although nothing changes. Without a graphics card
// that takes more than one CPU core. So this module holds back its pictures while the viewer gets no input and no data,
// and sends no event.

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
  const name = names ? gl.getParameter(names.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
};
const slow = drawnInSoftware();
if (slow) {
  for (const name of DRAWING) {
    const draw = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...values) {
      painted = true;
      return skipping ? undefined : draw.apply(this, values);
    };
  }
}

export const nextPicture = window.requestAnimationFrame.bind(window);
const held = [];
let last = performance.now();
let left = PICTURES; // pictures that it may draw without a sign

// Let the viewer draw for a while, and until it has read these bytes.
export function wake(bytes = 0) {
  last = performance.now();
  left = Math.max(left, PICTURES) + Math.ceil(bytes / READ);
  for (const draw of held.splice(0)) nextPicture(draw);
}

window.requestAnimationFrame = (draw) => {
  if (left <= 0 && performance.now() - last > AWAKE) return held.push(draw) && 0;
  if (!slow) left -= 1;
  return nextPicture(slow ? (now) => drawOrSkip(draw, now) : draw);
};

// Call the viewer for a picture, and count it if it has painted one.
function drawOrSkip(draw, now) {
  painted = false;
  skipping = left > PICTURES && pictures % DRAWN !== 0 && now - pointed > HELD;
  draw(now);
  if (painted) {
    pictures += 1;
    left -= 1;
    clearTimeout(finish);
    if (skipping) finish = setTimeout(redraw, FINISH);
  }
  skipping = false;
}

// Ask the viewer, which has read all, for a picture that is drawn.
function redraw() {
  left = Math.min(left, PICTURES);
  wake();
  window.dispatchEvent(new Event("hashchange")); // It repaints then.
}
function signed(event) {
  if (event.type.startsWith("pointer") && event.target.closest?.("#viewer")) pointed = performance.now();
  wake();
}
for (const sign of SIGNS) window.addEventListener(sign, signed, { capture: true, passive: true });
document.addEventListener("visibilitychange", () => wake());
