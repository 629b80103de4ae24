// The viewer (Rerun 0.41) redraws a 3D view or an image all the time, although nothing changes. Without a graphics card
// that takes more than one CPU core. So this module holds back its pictures while the viewer gets no input and no data,
// and sends no event.

const AWAKE = 3000; // ms of drawing after the last input, data or event
const PICTURES = 6; // pictures that it may always draw after that, on a slow machine as well
const SIGNS = ["pointerdown", "pointermove", "pointerup", "wheel", "keydown", "keyup", "touchstart", "touchmove", "resize",
  "focus", "blur", "dragover", "drop", "paste"];

export const nextPicture = window.requestAnimationFrame.bind(window);
const held = [];
let last = performance.now();
let begun = 0;

export function wake() {
  last = performance.now();
  begun = 0;
  for (const draw of held.splice(0)) nextPicture(draw);
}

window.requestAnimationFrame = (draw) => {
  begun += 1;
  if (begun > PICTURES && performance.now() - last > AWAKE) return held.push(draw) && 0;
  return nextPicture(draw);
};
for (const sign of SIGNS) window.addEventListener(sign, wake, { capture: true, passive: true });
document.addEventListener("visibilitychange", wake);
