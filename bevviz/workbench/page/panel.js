// The panel beside Rerun's viewer. It sends clicks to the server, which holds the drive, and shows the answers.

import { connect, newest, on, send, want } from "./connection.js";
import * as list from "./findings.js";
import * as jobs from "./jobs.js";
import { $, asked, element, remember, state, stated } from "./page_state.js";
import { drawnThen, isTried, kind, onViewer, seek, showSide } from "./viewer.js";

let controls = [];
let opened = []; // controls of the configuration that the drive was opened with

// --- questions and answers ----------------------------------------------------------------------

let asking = 0;
let askedTried = false; // the newest question is about the tried side
function ask(what) {
  if (state.time === null) return;
  asked.at = "entity" in what ? asked.released : performance.now();
  asked.sent = performance.now();
  $("answer").classList.add("busy");
  askedTried = isTried();
  asking = send({ type: "ask", time: Number(state.time), set: askedTried ? state.set : [], ...what });
}

// Row numbers differ between results, only those of the ground truth stay. So ask about the object's position.
const askAgain = () => ask({ pick: state.pick.startsWith("truth/") ? state.pick : state.place || state.pick });

function answer(message) {
  if (message.id !== asking) return;
  const took = performance.now() - asked.at;
  state.pick = message.pick;
  state.place = message.position ? `point//${message.position.join(",")}` : "";
  remember();
  // An object that a camera contradicts is no success, although it was reported.
  $("answer").className = message.empty ? "" : message.reported && message.reason !== "contradicted" ? "reported" : "missed";
  $("answer").dataset.took = took.toFixed(0);
  $("answer").dataset.server = (performance.now() - asked.sent).toFixed(0); // without the time that the viewer took
  $("verdict").textContent = message.verdict;
  const parts = [message.name, `frame ${message.frame}`];
  if (message.distance !== null) parts.push(`${message.distance} m away`);
  $("where").textContent = `${parts.join(" · ")} · answered in ${(took / 1000).toFixed(2)} s`;
  $("chain").replaceChildren(...message.chain.map((step) => (
    element("li", "", "", element("b", "", `${step.stage}: `), step.text))));
  $("beside").replaceChildren(...message.beside.map((other) => {
    const button = element("button", other.reported ? "" : "missed", `${other.name}: ${other.reason}`);
    button.onclick = () => ask({ pick: other.pick });
    return element("li", "", "", button);
  }));
  $("beside-title").hidden = !message.beside.length;
  $("hints").replaceChildren();
  if (!message.reported && !message.empty) $("hints").textContent = "Trying what would change it ...";
}

function nothing(message) {
  if (message.id !== asking) return;
  $("answer").className = "";
  $("verdict").textContent = `Nothing can be asked about ${message.entity}.`;
}

function failed(message) {
  if (message.id === trying) {
    $("effect").textContent = message.text;
    return;
  }
  if (message.id !== newest() && message.id !== asking) return;
  $("answer").className = "missed";
  $("verdict").textContent = message.text;
}

function hints(message) {
  if (message.id !== asking) return;
  $("hints").replaceChildren(...message.hints.map((hint) => {
    const button = element("button", "", `try ${hint.settings.join(", ")}`,
      element("small", "", [hint.text, effects(hint)].filter(Boolean).join("; ")));
    button.onclick = () => change(hint.settings);
    return button;
  }));
  if (!message.remark) return;
  if (!message.hints.length) $("hints").textContent = message.remark;
  list.explain(message.frame, state.pick, askedTried, message.remark);
}

// Describe the effects of other values on a frame. Hints and tried values use the same words.
function effects(effect) {
  const rest = (all, some) => all.filter((name) => !some.includes(name));
  const parts = Object.entries({
    fixes: effect.fixed, adds: rest(effect.added, effect.false), "wrongly adds": effect.false,
    loses: effect.right, drops: rest(effect.lost, effect.right),
  }).filter(([, names]) => names.length).map(([what, names]) => `${what} ${names.join(", ")}`);
  if (effect.changed) parts.push(`changes ${effect.changed}`);
  return parts.join("; ");
}

// --- other values -------------------------------------------------------------------------------

function change(settings) {
  state.undo.push(state.set);
  const keys = new Set(settings.map((one) => one.split("=")[0]));
  // The parameters of a method are removed with it.
  const gone = [...keys].filter((key) => key.endsWith(".method")).map((key) => key.replace(/method$/, "params."));
  const stays = (key) => !keys.has(key) && !gone.some((start) => key.startsWith(start));
  state.set = [...state.set.filter((one) => stays(one.split("=")[0])), ...settings];
  state.flipped = false;
  changed();
}

function changed() {
  remember();
  $("changed").hidden = !state.set.length && !state.undo.length;
  $("drive").disabled = !state.set.length;
  $("changes").replaceChildren(...state.set.map((one) => element("li", "", one)));
  $("save").href = `/config.yaml?${new URLSearchParams(state.set.map((one) => ["set", one]))}`;
  showControls();
  attempt();
}

let trying = 0;
let tryingSince = 0;
function attempt() {
  if (state.time === null) return;
  tryingSince = performance.now();
  showSide();
  if (state.set.length || kind === "live") { // A robot needs empty settings, too.
    $("effect").textContent = "Running the stages ...";
    trying = send({ type: "try", time: Number(state.time), set: state.set, pick: state.pick });
  } else {
    $("effect").textContent = "As it was opened.";
    offer({ controls: opened });
  }
  if (state.pick) askAgain();
}

function tried(message) {
  if (message.id !== trying) return;
  const since = tryingSince;
  const took = () => (performance.now() - since).toFixed(0);
  $("effect").dataset.took = took();
  drawnThen(() => { $("effect").dataset.drawn = took(); });
  const opinions = Object.entries(message.opinions).map(([what, both]) => `${what} ${both.map((one) => one ?? "–").join(" → ")}`);
  const parts = [[effects(message.effects), ...opinions].filter(Boolean).join("; ") || "changes nothing that is reported"];
  if (message.f1) parts.push(`F1 ${message.f1.map((one) => one ?? "–").join(" → ")}`);
  parts.push(...message.failures);
  $("effect").textContent = `${parts.join("; ")}.`;
}

// Switch between the frame as opened and as tried.
function flip() {
  if (!state.set.length) return;
  state.flipped = !state.flipped;
  $("flip").setAttribute("aria-pressed", state.flipped);
  $("side").textContent = state.flipped ? "shown: before" : "shown: after";
  remember();
  showSide();
  if (state.pick) askAgain();
}

// Show the side of a listed finding: with the settings of the newest trial, or as opened.
function tryOut(withThem) {
  const wanted = jobs.settings();
  if (wanted && wanted.join() !== state.set.join()) {
    state.undo.push(state.set);
    state.set = wanted;
    changed();
  }
  if (state.flipped === withThem) flip();
}

// --- parameters ---------------------------------------------------------------------------------

function showControls() {
  const words = $("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  const changes = new Map(state.set.map((one) => [one.slice(0, one.indexOf("=")), one.slice(one.indexOf("=") + 1)]));
  const wanted = controls.filter((one) => changes.has(one.key) || (words.length
    && words.every((word) => `${one.key} ${one.about} ${one.unit}`.toLowerCase().includes(word))));
  // Changed parameters first, then those with the words in their name: 'eps' is also in 'keeps' of a description.
  const rank = (one) => (changes.has(one.key) ? 0 : 1 + Number(!words.every((word) => one.key.includes(word))));
  wanted.sort((a, b) => rank(a) - rank(b));
  const focused = document.activeElement?.id;
  $("controls").replaceChildren(...wanted.map((one) => control(one, changes)));
  if (focused?.startsWith("control-")) $(focused)?.focus();
}

// Show new controls. A user's function that replaces a stage has parameters of its own.
function offer(message) {
  controls = message.controls;
  showControls();
}

function control(one, changes) {
  const label = element("label", "", one.key);
  const input = document.createElement(one.kind === "choice" ? "select" : "input");
  const value = changes.get(one.key) ?? (one.value ?? "");
  input.id = `control-${one.key}`;
  label.htmlFor = input.id;
  const low = one.low === undefined ? "" : `from ${one.low}`;
  const high = one.high === undefined ? "" : `up to ${one.high}`;
  const about = element("small", "", [one.about, one.unit, `${low} ${high}`.trim(), `opened with ${one.value ?? "nothing"}`]
    .filter(Boolean).join("; "));
  if (one.kind === "choice") input.append(...one.choices.map((name) => new Option(name, name, false, name === value)));
  else if (one.kind === "switch") { input.type = "checkbox"; input.checked = String(value) === "true"; }
  else input.value = typeof value === "object" ? JSON.stringify(value) : value;
  if (one.kind === "whole" || one.kind === "number") { input.inputMode = "decimal"; }
  input.onchange = () => {
    const text = one.kind === "switch" ? String(input.checked) : input.value;
    change([`${one.key}=${text === "" ? "null" : text}`]);
  };
  return element("div", changes.has(one.key) ? "control changed" : "control", "", label, input, about);
}

// --- session state from the server --------------------------------------------------------------

function open({ stamp }) {
  if (state.opening !== null) return;
  const same = stated.get("bag") === state.bag;
  state.first = stamp;
  state.opening = (same && stated.get("at")) || stamp;
  seek(state.opening);
  if (!same) return;
  state.set = stated.getAll("set");
  state.pick = stated.get("pick") ?? "";
  if (state.set.length) {
    state.undo.push([]);
    changed();
    if (stated.get("side") === "before") flip();
  } else if (state.pick) ask({ pick: state.pick });
}

function welcome(message) {
  state.bag = message.bag;
  state.run = message.run;
  document.title = `${message.bag} · bevviz`;
  $("bag").textContent = message.bag;
  controls = opened = message.controls;
  list.restart();
  if (!message.detector) $("run").title = "no detector: give --model";
  showControls();
}

on({
  welcome, controls: offer, answer, nothing, hints, tried, opening: open, error: failed, progress: jobs.progress,
  entries: list.update, remark: ({ frame, pick, text }) => list.explain(frame, pick, false, text), notes: list.notes, noted: jobs.noted,
});
onViewer({
  clicked: ask,
  settled: () => {
    remember();
    want(state.time);
    if (isTried()) attemptThere();
    else if (kind !== "live") send({ type: "settle", time: Number(state.time), set: [] });
    if ($("here").checked) list.draw();
  },
  shown: () => send({ type: "shown" }),
  sought: want,
});

function attemptThere() {
  $("effect").textContent = "Running the stages ...";
  trying = send({ type: "try", time: Number(state.time), set: state.set });
}

// --- keys and buttons ---------------------------------------------------------------------------

function undo() {
  if (!state.undo.length) return;
  state.set = state.undo.pop();
  changed();
}

const actions = {
  n: () => list.step(1),
  p: () => list.step(-1),
  u: undo,
  b: flip,
  r: () => $("drive").click(),
  "/": () => $("search").focus(),
};
$("undo").onclick = undo;
$("flip").onclick = flip;
$("reset").onclick = () => { state.undo.push(state.set); state.set = []; state.flipped = false; changed(); };
$("copy").onclick = () => navigator.clipboard.writeText(state.set.map((one) => `--set '${one}'`).join(" "));
$("search").oninput = showControls;
window.addEventListener("keydown", (event) => {
  const inPanel = event.target.closest?.("aside"); // The viewer has hidden inputs, too.
  const typing = inPanel && ["INPUT", "SELECT"].includes(event.target.tagName);
  if (typing && event.key === "Escape") event.target.blur();
  if (typing || event.ctrlKey || event.metaKey || event.altKey || !(event.key in actions)) return;
  event.preventDefault();
  event.stopPropagation();
  actions[event.key]();
}, true);

if (kind === "live") Object.assign(actions, (await import("./robot.js")).actions);
list.start(ask, tryOut);
if (kind !== "live") list.onBare((rows) => send({ type: "remarks", rows }));
list.onRemove((note) => send({ type: "unnote", stamp: note.stamp, text: note.text }));
jobs.start();
connect();
