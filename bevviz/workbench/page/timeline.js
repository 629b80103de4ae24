// Timeline under the viewer: one lane for each sort of finding, the shown time, and a click that goes there.
// The height of a bar is the number of findings at its time, its shade the distance of the nearest one.

import { bars, lanes, nearest, shade } from "./lanes.js";
import { $, at, frameTimes, shownFrame, spanText, state } from "./page_state.js";
import { kind, seek } from "./viewer.js";

/** @import { Span } from "./types" */
/** @import { Bar, Lane } from "./lanes.js" */
/** @import { Finding } from "./triage.js" */
/** @typedef {Bar & { y: number, half: number }} Mark a bar, and half of its width */

const NAMES = 64; // pixels for the names of the lanes
const HIT = 6; // pixels from the middle of a narrow mark that a click may be off
const ROW = 16; // pixels
const DRAG = 5; // pixels that the pointer moves until it marks a span
const LOWEST = 4; // pixels, of the bar of one finding
/** @type {Finding[]} */
let rows = [];
/** @type {(entry: Finding, row: number) => void} */
let choose = () => {};
/** @type {(span: Span) => void} */
let markSpan = () => {};
/** @type {{ x: number, row: number, marks: boolean } | null} */
let dragged = null; // where the pointer went down, and whether it marks a span
/** @type {Mark[]} */
let marks = [];
const [image, caption] = /** @type {[HTMLImageElement, HTMLElement]} */ (/** @type {unknown} */ ([...$("thumbnail").children]));
const picture = document.createElement("canvas"); // the marks, which are drawn again only when they change
let pictured = ""; // findings, frames and size that the picture has
let changes = 0; // number of changes of the findings

/**
 * @param {typeof choose} choosing
 * @param {typeof markSpan} marking
 */
export function start(choosing, marking) {
  [choose, markSpan] = [choosing, marking];
  $("events").onpointerdown = (event) => {
    dragged = kind === "live" ? null : { x: event.offsetX, row: rowAt(event), marks: false };
    $("events").setPointerCapture(event.pointerId);
  };
  $("events").onclick = (event) => { if (!dragged?.marks) clicked(event); };
  $("events").onkeydown = (event) => {
    const here = marks.filter((mark) => Math.abs(Number(mark.entry.sights[mark.row].stamp) - Number(state.time)) < 2000);
    if (event.key === "Enter" && here.length) choose(here[0].entry, here[0].row);
  };
  $("events").onpointermove = (event) => {
    if (event.buttons && dragged && (dragged.marks || Math.abs(event.offsetX - dragged.x) > DRAG)) {
      dragged.marks = true;
      const [low, high] = [dragged.row, rowAt(event)].sort((a, b) => a - b);
      markSpan({ first: frameTimes.stamp(low), last: frameTimes.stamp(high) });
      return;
    }
    const mark = markAt(event);
    $("events").title = mark ? told(mark) : "";
    showThumbnail(event, rowAt(event));
  };
  $("events").onpointerleave = () => { $("thumbnail").hidden = true; };
  image.onload = () => {
    caption.textContent = $("thumbnail").dataset.at ?? "";
    $("thumbnail").hidden = !$("events").matches(":hover");
  };
  image.onerror = () => { $("thumbnail").hidden = true; };
  new ResizeObserver(draw).observe($("events"));
}

/** @param {Finding[]} findings */
export function show(findings) {
  rows = findings;
  changes += 1;
  draw();
}

export function draw() {
  const canvas = $("events");
  const times = frameTimes();
  const shown = lanes(rows);
  canvas.hidden = times.length < 2 || (kind === "live" && !shown.length);
  if (canvas.hidden) return;
  canvas.ariaValueText = [at(state.time), state.span ? `${spanText(state.span)} marked` : ""].filter(Boolean).join(", ");
  canvas.ariaValueNow = String(shownFrame() ?? 0);
  canvas.ariaValueMax = String(frameTimes.number(times.length - 1));
  const width = canvas.clientWidth;
  const height = ROW * Math.max(1, shown.length) + 4;
  canvas.style.height = `${height}px`;
  const scale = window.devicePixelRatio || 1;
  const [first, last] = [times[0], times[times.length - 1]];
  const gap = times.reduce((least, time, row) => (row ? Math.min(least, time - times[row - 1]) : least), last - first);
  const share = Math.min(1 / times.length, gap / (last - first + gap)); // of the width, for each frame
  const each = Math.max(2, (width - NAMES) * share - 1);
  const x = (/** @type {string | number} */ stamp) => NAMES + each / 2 + ((Number(stamp) - first) / (last - first)) * (width - NAMES - each);
  const wanted = [changes, first, last, times.length, width, scale].join();
  if (wanted !== pictured) {
    pictured = wanted;
    drawMarks(shown, x, each, width, height, scale);
  }
  [canvas.width, canvas.height] = [width * scale, height * scale];
  const pen = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  pen.drawImage(picture, 0, 0);
  pen.scale(scale, scale);
  if (state.span) {
    const [low, high] = [state.span.first, state.span.last].map(x);
    pen.fillStyle = "rgb(255 255 255 / 18%)";
    pen.fillRect(low - each / 2, 0, high - low + each, height);
  }
  if (state.time !== null) {
    pen.fillStyle = getComputedStyle(document.documentElement).getPropertyValue("--text");
    pen.fillRect(x(state.time) - 0.5, 0, 1, height);
  }
}

/**
 * Draw one bar for each pixel of a lane, however many findings a long drive has there.
 * @param {Lane[]} shown
 * @param {(stamp: string | number) => number} x
 * @param {number} each width of a frame
 * @param {number} width
 * @param {number} height
 * @param {number} scale
 */
function drawMarks(shown, x, each, width, height, scale) {
  [picture.width, picture.height] = [width * scale, height * scale];
  const pen = /** @type {CanvasRenderingContext2D} */ (picture.getContext("2d"));
  pen.scale(scale, scale);
  const style = getComputedStyle(document.documentElement);
  pen.font = "10px system-ui, sans-serif";
  pen.textBaseline = "middle";
  const drawn = shown.map((lane, number) => ({ ...lane, y: 2 + ROW * number, bars: bars(lane, x) }));
  const most = Math.max(1, ...drawn.flatMap(({ bars }) => bars.map((bar) => bar.count)));
  marks = drawn.flatMap(({ y, bars }) => bars.map((bar) => ({ ...bar, y, half: Math.max(HIT, each / 2) })));
  for (const { name, color, y, bars } of drawn) {
    pen.fillStyle = style.getPropertyValue("--faint");
    pen.fillText(name, 8, y + ROW / 2);
    pen.fillStyle = style.getPropertyValue(color);
    for (const { x: middle, count, distance } of bars) {
      const tall = LOWEST + ((ROW - 2 - LOWEST) * (count - 1)) / Math.max(1, most - 1);
      pen.globalAlpha = shade(distance);
      pen.fillRect(middle - each / 2, y + ROW - 1 - tall, each, tall);
    }
    pen.globalAlpha = 1;
  }
}

/** @param {Mark} mark */
function told({ entry, row, count }) {
  const when = at(entry.sights[row].stamp);
  return count === 1 ? `${entry.what} ${entry.name} at ${when}` : `${count} at ${when}; the nearest: ${entry.what} ${entry.name}`;
}

/** @param {MouseEvent} event */
function markAt(event) {
  const near = marks.filter((mark) => Math.abs(mark.x - event.offsetX) <= mark.half && event.offsetY >= mark.y && event.offsetY < mark.y + ROW);
  return near.sort((a, b) => Math.abs(a.x - event.offsetX) - Math.abs(b.x - event.offsetX)).at(0);
}

/** @param {MouseEvent} event */
function clicked(event) {
  const mark = markAt(event);
  if (mark) choose(mark.entry, mark.row);
  else seek(frameTimes.stamp(rowAt(event)));
}

/**
 * Row of the frame at the pointer.
 * @param {MouseEvent} event
 */
function rowAt(event) {
  const times = frameTimes();
  const part = (event.offsetX - NAMES) / ($("events").clientWidth - NAMES);
  return nearest(times, times[0] + part * (times[times.length - 1] - times[0]));
}

/**
 * Show the camera near a frame above the pointer, if the server has an image of it. A robot has none.
 * @param {MouseEvent} event
 * @param {number} row
 */
function showThumbnail(event, row) {
  if (kind === "live" || event.offsetX < NAMES) { $("thumbnail").hidden = true; return; }
  const [figure, canvas] = [$("thumbnail"), $("events")];
  const path = `/thumbnail/${frameTimes.number(row)}`;
  figure.style.left = `${Math.max(112, Math.min(event.clientX, canvas.clientWidth - 112))}px`;
  figure.style.bottom = `${document.documentElement.clientHeight - canvas.getBoundingClientRect().top + 4}px`;
  figure.dataset.at = at(frameTimes.stamp(row));
  if (image.getAttribute("src") !== path) image.src = path;
  else figure.hidden = !image.naturalWidth;
}
