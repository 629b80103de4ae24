// One frame of the strip at a time, with a slider. Without JavaScript the strip scrolls sideways.
const strip = document.querySelector(".strip");
if (strip) {
  const frames = [...strip.children];
  const slider = document.createElement("input");
  slider.type = "range";
  slider.max = frames.length - 1;
  slider.value = Math.max(0, frames.findIndex((frame) => frame.classList.contains("here")));
  slider.setAttribute("aria-label", "frame");
  const show = () => frames.forEach((frame, i) => frame.classList.toggle("shown", i === Number(slider.value)));
  slider.addEventListener("input", show);
  strip.classList.add("single");
  strip.before(slider);
  show();
}
