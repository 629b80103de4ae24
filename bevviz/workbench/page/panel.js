// The panel beside Rerun's viewer. It sends clicks to the server, which holds the drive, and shows the answers.

import { connect, isConnected, on, send, want } from "./connection.js";
import * as list from "./findings.js";
import * as jobs from "./jobs.js";
import * as label from "./label.js";
import * as layout from "./layout.js";
import { $, addFrames, asked, beforeAfter, element, frameTimes, neighbour, remember, seconds, shownFrame, spanText, state, stated } from "./page_state.js";
import * as parameters from "./parameters.js";
import * as playback from "./playback.js";
import * as share from "./share.js";
import * as timeline from "./timeline.js";
import { isTried, kind, onViewer, playOrPause, seek, showSide } from "./viewer.js";

const REQUESTS = 300; // ms between two requests of frames while the time goes on

/** @import { AnswerMessage, Absent, Control, Error, Hints, Nothing, Opening, Origin, Robot, ChangedObjects, Span, Tried, Welcome } from "./types" */
/** @typedef {{ pick: string, origin: Origin | null }} Known */
/** @typedef {Known | import("./viewer.js").Click} Subject what is asked about */

/** @type {Control[]} */
let opened = []; // controls of the configuration that the drive was opened with

// --- questions and answers ----------------------------------------------------------------------

let asking = 0; // number of the newest question
let askedFor = ""; // frame and settings of the newest question
let askedTried = false; // the newest question is about the tried side

const shownSet = () => (isTried() ? state.set : []);
const shownKey = () => [shownFrame() ?? state.time, ...shownSet()].join();
const frameName = (/** @type {number | null} */ frame) => (frame === null ? `the frame at ${seconds(state.time)}` : `frame ${frame}`);
const withValues = (/** @type {string[]} */ set) => (set.length ? ` with ${set.join(", ")}` : "");

// A reloaded page does not know the numbers of the frames yet.
const unsentKey = () => [state.time, ...shownSet()].join();

// A question that was asked while the server was away is asked when it is back, by this page or the reloaded one.
function askUnsent() {
  const unsent = JSON.parse(sessionStorage.getItem("unsent") ?? "null");
  sessionStorage.removeItem("unsent");
  if (unsent && unsent.bag === state.bag && unsent.key === unsentKey()) ask(unsent.what);
  else return false;
  return true;
}

/** @param {Subject} what */
function ask(what) {
  if (state.time === null) return;
  if (!isConnected()) {
    sessionStorage.setItem("unsent", JSON.stringify({ bag: state.bag, key: unsentKey(), what }));
    clear("", "The server is away: this is asked when it is back.");
    return;
  }
  asked.at = "entity" in what ? asked.released : performance.now();
  asked.sent = performance.now();
  $("answer").classList.add("busy");
  askedTried = isTried();
  askedFor = shownKey();
  asking = send({ type: "ask", time: Number(state.time), set: shownSet(), ...what }, ({ id, text }) => {
    if (id !== asking) return;
    if (state.answer?.id === id) $("hints").textContent = text;
    else clear("missed", text);
  });
}

/** @param {Subject} what */
function askOther(what) {
  list.leave();
  remember(Boolean(state.pick));
  if ("pick" in what) [state.pick, state.origin] = [what.pick, what.origin];
  ask(what);
}

// Row numbers differ between frames and values. The address of an answer's object is valid in all of them.
// Until it has come, the row number goes with its frame and values.
const askAgain = () => {
  if (state.pick) ask({ pick: state.pick, origin: state.origin });
};

/**
 * Show a sentence in place of an answer. Nothing of the former answer stays.
 * @param {string} className
 * @param {string} text
 * @param {string} where
 */
function clear(className, text, where = "") {
  state.answer = null;
  label.close();
  $("answer").className = className;
  $("verdict").textContent = text;
  $("where").textContent = where;
  for (const id of /** @type {const} */ (["chain", "beside", "steps", "hints", "robot-chain", "further"])) $(id).replaceChildren();
  for (const id of /** @type {const} */ (["beside-title", "robot-title"])) $(id).hidden = true;
  freshness();
}

function forget() {
  asking = 0;
  state.pick = "";
  clear("", "Click a box, a point, a pixel: it answers why it is what it is.");
}

// Frames that the viewer has. Those on demand are requested a few times in a second while it plays.
const made = new Set();
let lastRequest = 0;
function requestOften() {
  if (!state.demand || made.has(shownFrame()) || performance.now() - lastRequest < REQUESTS) return;
  lastRequest = performance.now();
  want(state.time);
}

// Tell which frame is shown, and mark an answer or an effect of another frame or of other values.
function freshness() {
  const frame = shownFrame();
  const isMade = kind === "live" || frame === null || made.has(frame);
  const making = isMade ? "" : state.demand ? ", being made ..." : ", on its way: the views show an earlier frame ...";
  const at = state.single ? "" : seconds(state.time); // empty beside a robot
  $("shown").textContent = frame === null ? at : `Frame ${frame}${at && ` at ${at}`}${making}`;
  const { answer } = state;
  const isOther = frame === null ? askedFor !== shownKey() : answer?.frame !== frame;
  const isOld = answer !== null && (isOther || answer.set.join() !== shownSet().join());
  $("answer").classList.toggle("old", isOld);
  $("of").hidden = !isOld;
  $("of").textContent = isOld
    ? `This is about frame ${answer.frame}${withValues(answer.set)}; ${frameName(frame)}${withValues(shownSet())} is shown.` : "";
  for (const button of $("hints").querySelectorAll("button")) button.disabled = isOld;
  $("effect").classList.toggle("old", $("effect").dataset.frame !== String(frame));
  if (kind !== "live") playback.tellTime();
  timeline.draw();
}

/** @param {AnswerMessage} message */
function answer(message) {
  if (message.id !== asking) return;
  const took = performance.now() - asked.at;
  state.pick = message.pick;
  state.answer = { id: message.id, frame: message.frame, set: message.set };
  remember();
  // An object that a camera contradicts is no success, although it was reported.
  $("answer").className = message.empty ? "" : message.reported && message.reason !== "contradicted" ? "reported" : "missed";
  $("answer").dataset.took = took.toFixed(0);
  $("answer").dataset.server = (performance.now() - asked.sent).toFixed(0); // without the time that the viewer took
  $("verdict").textContent = message.verdict;
  const parts = [message.name, `frame ${message.frame}`];
  if (message.distance !== null && !message.name.includes(" m")) parts.push(`${message.distance.toFixed(1)} m away`);
  if (message.found) parts.push(`found ${message.found}`);
  $("where").textContent = `${parts.join(" · ")} · answered in ${(took / 1000).toFixed(2)} s`;
  $("chain").replaceChildren(...message.chain.map((step) => (
    element("li", "", "", element("b", "", `${step.stage}: `), step.text))));
  $("robot-chain").replaceChildren();
  $("robot-title").hidden = true;
  $("further").replaceChildren(...further(message).map((text) => element("p", "", text)));
  const origin = { time: Number(state.time), set: message.set };
  $("beside").replaceChildren(...message.beside.map((other) => {
    const button = element("button", other.reported ? "" : "missed", `${other.name}: ${other.reason}`);
    button.title = state.meanings[other.reason] ?? "";
    button.onclick = () => askOther({ pick: other.pick, origin });
    return element("li", "", "", button);
  }));
  $("beside-title").hidden = !message.beside.length;
  layout.show(message.cameras);
  label.close();
  $("steps").replaceChildren(...(message.labelled || message.place ? labelStep(message.labelled) : []));
  $("hints").textContent = message.reported || message.empty ? "" : "Trying what would change it ...";
  freshness();
  list.showAnswer();
}

// Say what the verdict leaves open: two reasons of which nothing tells which one mattered, and stages that bring it back.
/** @param {AnswerMessage} message */
function further({ likely, restored_by: restored }) {
  const texts = [];
  if (likely.length) texts.push(`Either of two reasons may have lost it: ${likely.join(" or ")}.`);
  if (restored.length) texts.push(`It comes back with ideal results of ${restored.map((stages) => stages.join(" and ")).join(", or of ")}.`);
  return texts;
}

/** @param {Nothing} message */
function nothing(message) {
  if (message.id !== asking) return;
  state.pick = "";
  remember();
  clear("", `Nothing can be asked about ${message.entity}.`);
}

/**
 * The object is in another frame only. It stays the subject, and is found again where it is.
 * @param {Absent} message
 */
function absent(message) {
  if (message.id !== asking) return;
  state.pick = message.pick;
  remember();
  clear("", message.text, `frame ${message.frame}${withValues(message.set)}`);
  state.answer = { id: message.id, frame: message.frame, set: message.set };
  freshness();
}

/**
 * The robot's own chain: what each of its nodes did with the object, with the usual delay and loss of the node.
 * @param {Robot} message
 */
function robotChain(message) {
  if (message.id !== asking) return;
  $("robot-title").hidden = false;
  $("robot-title").textContent = `The robot's own nodes: ${message.text}.`;
  $("robot-chain").replaceChildren(
    ...message.steps.map((step) => element("li", step.changed ? "missed" : "", step.text || "not reached", element("small", "", step.about))),
    ...message.notes.map((note) => element("li", "", "", element("small", "", note))),
  );
  const list = $("robot-chain");
  const changed = /** @type {HTMLElement | null} */ (list.querySelector(".missed"));
  if (changed) list.scrollTop = changed.offsetTop - list.offsetTop - list.clientHeight / 2;
}

/** @param {Error} message */
function failed(message) {
  $("noted").textContent = message.text;
  $("noted").className = "alarm";
}

/** @param {Hints} message */
function hints(message) {
  if (message.id !== asking) return;
  $("hints").replaceChildren(...message.hints.map((hint) => {
    const meaning = [hint.text, effects(hint)].filter(Boolean).join("; ");
    return list.offered(`try ${hint.settings.join(", ")}`, meaning, () => change(hint.settings));
  }));
  freshness();
  if (!message.remark) return;
  if (!message.hints.length) {
    $("hints").textContent = message.remark;
    const own = $("steps").querySelector(".label");
    $("steps").replaceChildren(...(own ? [own] : labelStep(false)), ...message.methods.map(otherMethod),
      ...(askedTried ? [] : list.nextSteps(message.frame, message.row_pick)),
      list.offered("hand it on", "a report of this frame and answer, to be run again elsewhere", () => $("report").click()));
  }
  list.explain({ ...message, pick: message.row_pick }, askedTried);
}

/** @param {string} setting names another method of the stage that may have lost the object */
function otherMethod(setting) {
  return list.offered(`try another stage: ${setting}`, "runs this frame with it, and says what is fixed and broken", () => change([setting]));
}

/**
 * The button by which the user draws the object's box. A bag with ground truth needs none.
 * @param {boolean} isKept
 */
function labelStep(isKept) {
  if (state.truth || kind === "live" || askedTried) return [];
  const button = list.offered(isKept ? "change its label" : "draw its box", isKept ? "the × of its note in the list removes it"
    : "it is kept as truth beside the bag, and the answer becomes exact", label.open);
  button.classList.add("label");
  return [button];
}

/**
 * Describe the effects of other values on a frame. Hints and tried values use the same words.
 * @param {ChangedObjects} effect
 */
function effects(effect) {
  const rest = (/** @type {string[]} */ all, /** @type {string[]} */ some) => all.filter((name) => !some.includes(name));
  const parts = Object.entries({
    fixed: effect.fixed, broken: effect.right, "new false": effect.false,
    "false gone": effect.false_gone, gone: rest(effect.lost, effect.right), new: rest(effect.added, effect.false),
  }).filter(([, names]) => names.length).map(([what, names]) => `${what}: ${names.join(", ")}`);
  if (effect.changed) parts.push(`${effect.changed} changed`);
  return parts.join("; ");
}

// --- other values -------------------------------------------------------------------------------

/** @param {string[]} settings */
function use(settings) {
  state.undo.push(state.set);
  state.redo = [];
  state.set = settings;
  state.flipped = false;
  changed();
}

/** @param {string[]} settings */
function change(settings) {
  const keys = new Set(settings.map((one) => one.split("=")[0]));
  // The parameters of a method are removed with it.
  const gone = [...keys].filter((key) => key.endsWith(".method")).map((key) => key.replace(/method$/, "params."));
  const stays = (/** @type {string} */ key) => !keys.has(key) && !gone.some((start) => key.startsWith(start));
  use([...state.set.filter((one) => stays(one.split("=")[0])), ...settings]);
}

function changed() {
  remember();
  $("changed").hidden = !state.set.length && !state.undo.length;
  $("drive").disabled = !state.set.length;
  tellSide();
  $("changes").replaceChildren(...state.set.map((one) => element("li", "", one)));
  $("save").href = `/config.yaml?${new URLSearchParams(state.set.map((one) => ["set", one]))}`;
  parameters.show();
  jobs.showRuns();
  attempt();
}

let trying = 0; // number of the newest trial
let tryingSince = 0;
let triedFor = ""; // frame and settings of the newest trial
/** @type {string[]} */
let valid = []; // the last settings that the server has accepted
function attempt() {
  if (state.time === null) return;
  tryingSince = performance.now();
  showSide();
  $("effect").className = "";
  if (state.set.length || kind === "live") tryHere(); // A robot needs empty settings, too.
  else {
    if (trying) send({ type: "cancel", what: "try" });
    tryOver();
    triedFor = "";
    valid = [];
    $("effect").textContent = "As it was opened.";
    $("effect").dataset.frame = String(shownFrame());
    parameters.offer(opened);
  }
  askAgain();
}

function tryHere() {
  const frame = shownFrame();
  triedFor = shownKey();
  $("effect").textContent = `Running the stages on ${frameName(frame)} ...`;
  $("effect").dataset.frame = String(frame);
  $("try-cancel").hidden = kind === "live";
  const set = state.set;
  trying = send({ type: "try", time: Number(state.time), set, pick: state.pick }, ({ id, text }) => {
    if (id !== trying) return;
    if (valid.join() !== set.join()) { // Invalid settings are in force nowhere.
      state.set = valid;
      if (state.undo.at(-1)?.join() === valid.join()) state.undo.pop();
      changed();
    }
    $("effect").textContent = text;
    $("effect").className = "alarm";
    tryOver();
  });
}

function tryOver() {
  trying = 0;
  $("try-cancel").hidden = true;
}

// Go back to the values before the slow ones.
function cancelTry() {
  if (!trying) return;
  send({ type: "cancel", what: "try" });
  tryOver();
  triedFor = "";
  if (valid.join() !== state.set.join()) {
    state.set = valid;
    changed();
  } else {
    $("effect").textContent = `Cancelled: these values are not shown for ${frameName(shownFrame())}.`;
    triedFor = shownKey();
  }
}

/** @param {Tried} message */
function tried(message) {
  if (message.id !== trying) return;
  tryOver();
  valid = message.set;
  $("effect").dataset.took = (performance.now() - tryingSince).toFixed(0);
  $("effect").dataset.frame = String(message.frame);
  const opinions = Object.entries(message.opinions).map(([what, both]) => `${what} ${beforeAfter(both)}`);
  const parts = [[effects(message.effects), ...opinions].filter(Boolean).join("; ") || "changes nothing that is reported"];
  if (message.f1) parts.push(`F1 ${beforeAfter(message.f1)}`);
  parts.push(...message.failures);
  $("effect").textContent = `Frame ${message.frame}: ${parts.join("; ")}.`;
  freshness();
}

// Switch between the frame as opened and as tried.
function flip() {
  if (!state.set.length || kind === "live") return; // A robot has no tried side.
  state.flipped = !state.flipped;
  tellSide();
  remember();
  showSide();
  freshness();
  askAgain();
}

// Tell which side is shown. Other values show their own side again.
function tellSide() {
  const isBefore = state.set.length > 0 && state.flipped;
  $("flip").ariaPressed = String(isBefore);
  $("side").textContent = isBefore ? "shown: before" : isTried() ? "shown: after" : "";
}

/**
 * Show the side of a listed finding: with the settings of the newest trial, or as opened.
 * @param {boolean} withThem
 */
function tryOut(withThem) {
  const wanted = jobs.settings();
  if (wanted && wanted.join() !== state.set.join()) use(wanted);
  if (state.flipped === withThem) flip();
}

// --- session state from the server --------------------------------------------------------------

/** @param {Opening} message */
function open({ stamp, first, demand }) {
  if (state.opening !== null) return;
  state.first = first;
  state.demand = demand;
  const same = share.sameDrive();
  state.opening = (same && stated.get("at")) || stamp;
  seek(state.opening);
  list.draw(); // An earlier run's list may be there already, without the time that seconds count from.
  if (!same) return;
  state.set = stated.getAll("set");
  const [low, high] = (stated.get("span") ?? "").split("-");
  if (high) markSpan({ first: low, last: high });
  state.pick = stated.get("pick") ?? "";
  state.origin = { time: Number(state.opening), set: state.set };
  if (state.set.length) {
    state.undo.push([]);
    changed();
    if (stated.get("side") === "before") flip();
  } else if (!askUnsent()) askAgain();
}

/** @param {Welcome} message */
function welcome(message) {
  const { bag, run, meanings, truth, single } = message;
  Object.assign(state, { bag, run, meanings, truth, single });
  document.title = `${message.bag} · bevviz`;
  $("bag").textContent = message.bag;
  opened = message.controls;
  share.welcomed(message);
  $("fixing").hidden = kind === "live" || !message.truth;
  legend(message.classes);
  list.restart();
  $("detector").hidden = message.detector;
  if (kind === "live") $("changed-title").textContent = "In force on the robot, from the next frame on";
  parameters.offer(opened);
  if (state.opening !== null) askUnsent();
}

/** @param {Record<string, string>} classes */
function legend(classes) {
  $("classes").replaceChildren(...Object.entries(classes).map(([name, color]) => {
    const swatch = element("span", "swatch", "");
    swatch.style.background = color;
    return element("li", "", "", swatch, name);
  }));
}

/** @type {string | null} */
let knownLabels = null; // The shown answer may depend on them.
on({
  welcome, controls: (message) => parameters.offer(message.controls), answer, robot: robotChain, nothing, absent, hints, frames: (message) => { addFrames(message); freshness(); },
  tried, opening: open, error: failed, progress: jobs.progress, entries: list.update, noted: jobs.noted,
  notes: (message) => {
    list.notes(message);
    const labels = JSON.stringify(message.notes.filter((note) => note.label));
    if (knownLabels !== null && labels !== knownLabels) askAgain();
    knownLabels = labels;
  },
  label: label.drawn,
  remark: (message) => list.explain(message),
  made: (frame) => { made.add(frame); freshness(); },
  // The viewer frees nothing, and loses its layout where a recording is closed. The address shows the same again.
  full: () => { remember(); location.reload(); },
});
onViewer({
  clicked: askOther,
  moved: () => { freshness(); requestOften(); },
  settled: () => {
    remember();
    want(state.time);
    if (isTried() && triedFor !== shownKey()) tryHere();
    if (state.pick && askedFor !== shownKey()) askAgain();
    else if (kind !== "live") send({ type: "settle", time: Number(state.time), set: shownSet() });
    if ($("here").checked) list.draw();
  },
  shown: () => send({ type: "shown" }),
  sought: want,
});

// --- keys and buttons ---------------------------------------------------------------------------

/**
 * Go to the newest values of one list, and keep the present ones in the other.
 * @param {string[][]} from
 * @param {string[][]} to
 */
function restore(from, to) {
  const next = from.pop();
  if (!next) return;
  to.push(state.set);
  state.set = next;
  changed();
}
const undo = () => restore(state.undo, state.redo);
const redo = () => restore(state.redo, state.undo);

// Back and Forward of the browser walk through the subjects.
window.addEventListener("popstate", (event) => {
  const parts = new URLSearchParams(location.hash.slice(1));
  const at = parts.get("at");
  if (!event.state || !at) return;
  list.leave();
  const set = parts.getAll("set");
  [state.pick, state.origin] = [parts.get("pick") ?? "", { time: Number(at), set }];
  state.flipped = parts.get("side") === "before";
  seek(at);
  if (set.join() !== state.set.join()) {
    state.undo.push(state.set);
    state.set = set;
    changed();
  } else if (state.pick) askAgain();
  else forget();
});

/** @param {number} by */
function stepFrame(by) {
  const [stamp, next] = [neighbour(by), (shownFrame() ?? -Infinity) + by];
  if (stamp !== null) seek(stamp);
  else if (!state.over && next >= 0) {
    freshness();
    $("shown").textContent += `. Frame ${next} has not been run yet.`;
  }
}

const toEnd = (/** @type {boolean} */ isLast) => {
  const times = frameTimes();
  if (times.length) seek(frameTimes.stamp(isLast ? times.length - 1 : 0));
};

/**
 * Mark the frames from one stamp to another; null: none. It is played, noted, reported and run alone.
 * @param {Span | null} span
 */
function markSpan(span) {
  state.span = span;
  $("span").hidden = !span;
  $("of-span").hidden = !span;
  for (const label of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll(".around"))) label.hidden = Boolean(span);
  if (span) {
    $("span-text").textContent = `${spanText(span)} marked`;
    $("of-span").textContent = `of ${spanText(span)}`;
    $("drive-span").textContent = `run ${spanText(span)}`;
  }
  $("drive-span").hidden = !span;
  timeline.draw();
  remember();
}

/**
 * Begin or end the span at the shown frame. The other end stays where it was, if it can.
 * @param {boolean} isEnd
 */
function markHere(isEnd) {
  const times = frameTimes();
  if (kind === "live" || times.length < 2) return;
  const { first, last } = state.span ?? { first: frameTimes.stamp(0), last: frameTimes.stamp(times.length - 1) };
  const here = frameTimes.stamp(Math.max(0, frameTimes.row(state.time)));
  if (isEnd) markSpan({ first: Number(first) <= Number(here) ? first : here, last: here });
  else markSpan({ first: here, last: Number(last) >= Number(here) ? last : here });
}

/** @type {Record<string, () => void>} */
const actions = {
  " ": kind === "live" ? playOrPause : playback.toggle,
  "<": () => playback.faster(-1),
  ">": () => playback.faster(1),
  l: playback.toggleLoop,
  i: () => markHere(false),
  o: () => markHere(true),
  x: () => markSpan(null),
  ArrowLeft: () => stepFrame(-1),
  ArrowRight: () => stepFrame(1),
  Home: () => toEnd(false),
  End: () => toEnd(true),
  ",": () => stepFrame(-1),
  ".": () => stepFrame(1),
  "?": () => { if ($("help").open) $("help").close(); else $("help").showModal(); },
  n: () => list.step(1),
  p: () => list.step(-1),
  u: undo,
  b: flip,
  r: () => $("drive").click(),
  "/": () => $("search").focus(),
};
$("undo").onclick = undo;
$("flip").onclick = flip;
$("reset").onclick = () => use([]);
$("copy").onclick = () => navigator.clipboard.writeText(state.set.map((one) => `--set '${one}'`).join(" "));
$("try-cancel").onclick = cancelTry;
$("keys").onclick = actions["?"];
$("help").onclick = () => $("help").close();
let hasTabbed = false; // the focus came by Tab
window.addEventListener("pointerdown", () => { hasTabbed = false; }, true);
window.addEventListener("keydown", (event) => {
  if (event.key === "Tab") hasTabbed = true;
  const target = event.target instanceof Element ? event.target : document.body;
  const inPanel = target.closest("aside"); // The viewer has hidden inputs, too.
  const typing = inPanel && target instanceof HTMLInputElement && target.matches(":not([type=range], [type=checkbox])");
  if (typing && event.key === "Escape") target.blur();
  const hasText = typing && target.value !== target.defaultValue; // Its own undo takes back what was typed.
  if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z" && !hasText) {
    event.preventDefault();
    event.stopPropagation();
    (event.shiftKey ? redo : undo)();
  }
  if (typing || event.ctrlKey || event.metaKey || event.altKey || !(event.key in actions)) return;
  // A control that was reached by Tab keeps its own keys. One that was clicked does not.
  const own = event.key === " " ? "[type=checkbox], [type=range], summary, button, select, a" : event.key.length > 1 ? "[type=range], select" : "";
  if (own && hasTabbed && target.matches(own)) return;
  event.preventDefault();
  event.stopPropagation();
  actions[event.key]();
}, true);
$("span-clear").onclick = actions.x;
if (kind === "live") {
  const robot = await import("./robot.js");
  Object.assign(actions, robot.actions);
  on({ progress: (message) => { jobs.progress(message); robot.progress(message); } });
}
/** @type {Pick<import("./findings.js").Actions, "remarks" | "handle">} */
const ofDrive = kind === "live" ? {} : {
  remarks: (rows) => send({ type: "remarks", rows }),
  handle: (finding) => send({ type: "handle", finding }),
};
list.start({
  ask, tryOut, forget, markSpan, drawn: timeline.show, triedSet: () => jobs.settings() ?? [], ...ofDrive,
  unnote: (note) => send({ type: "unnote", stamp: note.stamp, text: note.text }),
});
parameters.start(change);
label.start(askAgain);
timeline.start(list.choose, markSpan);
if (kind !== "live") playback.start();
share.start();
jobs.start((settings) => {
  if (settings.join() !== state.set.join()) use(settings);
});
connect();
