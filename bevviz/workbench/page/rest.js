// With a view of space or an image the viewer (Rerun 0.41) begins its next picture as soon as one is drawn, although
// nothing changes: without a graphics card that is more than a core, for ever. Its pictures are held back while nothing
// happens: no input, nothing new for it, nothing that it tells.

const AWAKE = 3000; // ms after what happened last
const PICTURES = 6; // that it may begin at least after that, however long they take
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
