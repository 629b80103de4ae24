// Timeline under the viewer: one lane for each sort of finding, the shown time, and a click that goes there.

import { $, at, frameTimes, state } from "./page_state.js";
import { kind, seek } from "./viewer.js";

const LANES = [
  ["missed", "--bad", ["missed", "lost", "unmatched", "broken"]],
  ["false", "--doubtful", ["false", "doubtful", "contradicted", "new false"]],
  ["unnamed", "--unknown", ["unnamed", "new", "gone"]],
  ["fixed", "--good", ["fixed", "false gone"]],
  ["anomaly", "--other", ["anomaly"]],
  ["note", "--subject", ["note"]],
];
const NAMES = 64; // pixels for the names of the lanes
const HIT = 6; // pixels from the middle of a narrow mark that a click may be off
const ROW = 12; // pixels

let rows = [];
let choose = () => {};
let marks = []; // x, y, half of the width, entry and row of its sight, of each mark that is drawn
const picture = document.createElement("canvas"); // the marks, which are drawn again only when they change
let pictured = ""; // findings, frames and size that the picture has
let changes = 0; // number of changes of the findings

export function start(choosing) {
  choose = choosing;
  $("events").onclick = clicked;
  $("events").onpointermove = (event) => {
    const mark = markAt(event);
    $("events").title = mark ? `${mark.entry.what} ${mark.entry.name} at ${at(mark.entry.sights[mark.row][1])}` : "";
    showThumbnail(event, rowAt(event));
  };
  $("events").onpointerleave = () => { $("thumbnail").hidden = true; };
  $("thumbnail").firstChild.onload = () => {
    $("thumbnail").lastChild.textContent = $("thumbnail").dataset.at;
    $("thumbnail").hidden = !$("events").matches(":hover");
  };
  $("thumbnail").firstChild.onerror = () => { $("thumbnail").hidden = true; };
  new ResizeObserver(draw).observe($("events"));
}

export function show(findings) {
  rows = findings;
  changes += 1;
  draw();
}

function lanes() {
  return LANES.map(([name, color, kinds]) => ({ name, color, entries: rows.filter((entry) => kinds.includes(entry.what)) }))
    .filter((lane) => lane.entries.length);
}

export function draw() {
  const canvas = $("events");
  const times = frameTimes();
  const shown = lanes();
  canvas.hidden = times.length < 2 || !shown.length;
  if (canvas.hidden) return;
  const width = canvas.clientWidth;
  const height = ROW * shown.length + 4;
  canvas.style.height = `${height}px`;
  const scale = window.devicePixelRatio || 1;
  const [first, last] = [times[0], times.at(-1)];
  const each = Math.max(2, (width - NAMES) / times.length - 1);
  const x = (stamp) => NAMES + each / 2 + ((Number(stamp) - first) / (last - first)) * (width - NAMES - each);
  const wanted = [changes, first, last, times.length, width, scale].join();
  if (wanted !== pictured) {
    pictured = wanted;
    drawMarks(shown, x, each, width, height, scale);
  }
  [canvas.width, canvas.height] = [width * scale, height * scale];
  const pen = canvas.getContext("2d");
  pen.drawImage(picture, 0, 0);
  if (state.time !== null) {
    pen.scale(scale, scale);
    pen.fillStyle = getComputedStyle(document.documentElement).getPropertyValue("--text");
    pen.fillRect(x(state.time) - 0.5, 0, 1, height);
  }
}

// Draw one mark for each pixel of a lane, however many findings a long drive has there.
function drawMarks(shown, x, each, width, height, scale) {
  [picture.width, picture.height] = [width * scale, height * scale];
  const pen = picture.getContext("2d");
  pen.scale(scale, scale);
  const style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue(name);
  marks = [];
  pen.font = "10px system-ui, sans-serif";
  pen.textBaseline = "middle";
  for (const [number, lane] of shown.entries()) {
    const y = 2 + ROW * number;
    pen.fillStyle = color("--faint");
    pen.fillText(lane.name, 8, y + ROW / 2);
    pen.fillStyle = color(lane.color);
    const drawn = new Set();
    for (const entry of lane.entries) {
      for (const [row, one] of entry.sights.entries()) {
        const at = x(one[1]);
        if (drawn.size === drawn.add(Math.round(at)).size) continue;
        pen.fillRect(at - each / 2, y + 2, each, ROW - 4);
        marks.push({ x: at, y, half: Math.max(HIT, each / 2), entry, row });
      }
    }
  }
}

function markAt(event) {
  const near = marks.filter((mark) => Math.abs(mark.x - event.offsetX) <= mark.half && event.offsetY >= mark.y && event.offsetY < mark.y + ROW);
  return near.reduce((best, mark) => (!best || Math.abs(mark.x - event.offsetX) < Math.abs(best.x - event.offsetX) ? mark : best), null);
}

function clicked(event) {
  const mark = markAt(event);
  if (mark) choose(mark.entry, mark.row);
  else seek(frameTimes.stamp(rowAt(event)));
}

// Row of the frame at the pointer.
function rowAt(event) {
  const times = frameTimes();
  const part = (event.offsetX - NAMES) / ($("events").clientWidth - NAMES);
  const wanted = times[0] + part * (times.at(-1) - times[0]);
  return times.reduce((row, at, other) => (Math.abs(at - wanted) < Math.abs(times[row] - wanted) ? other : row), 0);
}

// Show the camera near a frame above the pointer, if the server has an image of it. A robot has none.
function showThumbnail(event, row) {
  if (kind === "live" || event.offsetX < NAMES) { $("thumbnail").hidden = true; return; }
  const [figure, canvas] = [$("thumbnail"), $("events")];
  const path = `/thumbnail/${frameTimes.number(row)}`;
  figure.style.left = `${Math.max(112, Math.min(event.clientX, canvas.clientWidth - 112))}px`;
  figure.style.bottom = `${document.documentElement.clientHeight - canvas.getBoundingClientRect().top + 4}px`;
  figure.dataset.at = at(frameTimes.stamp(row));
  if (figure.firstChild.getAttribute("src") !== path) figure.firstChild.src = path;
  else figure.hidden = !figure.firstChild.naturalWidth;
}
