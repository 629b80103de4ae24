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
  left -= 1;
  return nextPicture(draw);
};
for (const sign of SIGNS) window.addEventListener(sign, () => wake(), { capture: true, passive: true });
document.addEventListener("visibilitychange", () => wake());
