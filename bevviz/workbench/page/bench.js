// The panel beside Rerun's viewer. What was clicked goes to the server, which holds the drive; it answers here.

const $ = (id) => document.getElementById(id);
const version = $("viewer").dataset.version;
const native = $("viewer").dataset.native === "true"; // Rerun's viewer is a window of its own
const widget = (await import(native ? "/page/native.js" : `/viewer/${version}/widget.js`)).default;

const TIMELINE = "stamp";
const SETTLED = 150; // ms without a change after which a frame is taken for one that is looked at
const RETRY = 1500; // ms between two tries to find the server again
const SHOWN = 400; // rows of the list that are in the page at once

const state = { bag: "", run: "", time: null, pick: "", set: [], given: [], undo: [], flipped: false };
let question = 0; // number of the newest one
let talk = null;
let found = [];
let current = -1;
let controls = [];
let opening = null; // stamp that is shown first
let asked = 0; // when the newest question was asked, to tell how long the answer took

// --- the viewer ---------------------------------------------------------------------------------
// Rerun's notebook widget, which keeps its own wrapper of the viewer up to date; this page is its notebook.

const listeners = {};
const settings = {
  _url: null, _width: "auto", _height: "auto", _theme: "dark", _fallback_token: null,
  _panel_states: { top: "hidden", blueprint: "hidden", selection: "hidden", time: "collapsed" },
};
const viewerReady = new Promise((ready) => {
  widget.render({
    model: {
      get: (name) => settings[name],
      on: (name, listener) => { listeners[name] = listener; },
      send: (message) => (message === "ready" ? ready() : viewerEvent(JSON.parse(message))),
    },
    el: $("viewer"),
  });
});
const toViewer = (message, buffers) => listeners["msg:custom"](message, buffers);
window.addEventListener("to-viewer", ({ detail }) => toViewer(detail));
const move = () => toViewer({ type: "time_ctrl", timeline: TIMELINE, timestamp_nanos: target, play: false });

// A viewer that has just opened a recording goes to its beginning of itself, and takes no time before that.
let target = null; // stamp that the viewer is on its way to
let tries = 0;
function seek(stamp) {
  target = String(stamp);
  tries = 3;
  move();
}

let settling = 0;
function viewerEvent(event) {
  window.dispatchEvent(new CustomEvent("viewer-event", { detail: event }));
  if (event.type === "recording_open" && opening !== null) seek(opening);
  if (event.type === "time_update" && (event.timeline ?? TIMELINE) === TIMELINE) {
    if (target !== null && Number(target) !== event.time && tries > 0) {
      tries -= 1;
      move();
      return;
    }
    target = null;
    if (state.time !== null && Number(state.time) === event.time) return;
    state.time = String(BigInt(Math.round(event.time)));
    clearTimeout(settling);
    settling = setTimeout(settled, SETTLED);
  }
  if (event.type === "selection_change") {
    const item = event.items.find((one) => one.type === "entity");
    if (item) ask({ entity: item.entity_path, instance: item.instance_id ?? null, position: item.position ?? null });
  }
}

function settled() {
  remember();
  if (state.set.length && !state.flipped) attempt();
  else send({ type: "settle", time: Number(state.time), set: state.set });
  if ($("here").checked) list();
}

// --- the server ---------------------------------------------------------------------------------

const socketAt = (path) => new WebSocket(`ws://${location.host}${path}`);
let pieces = 0; // of the film that the viewer has

function film() {
  const socket = socketAt(`/film?from=${pieces}`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = ({ data }) => {
    pieces += 1;
    toViewer({ type: "rrd" }, [new DataView(data)]);
  };
  return socket;
}

function connect() {
  let shown = null;
  talk = socketAt("/talk");
  talk.onopen = () => { gone(""); };
  talk.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.type === "welcome") {
      if (state.run && state.run !== message.run) { location.reload(); return; }
      welcome(message);
      viewerReady.then(() => { if (!native) shown = film(); });
    } else receive(message);
  };
  talk.onclose = async () => {
    shown?.close();
    gone("The server is gone: nothing is answered until it is back. Looking for it ...");
    setTimeout(async () => {
      try {
        const answer = await fetch("/page/bench.js", { method: "HEAD", cache: "no-store" });
        if (answer.status === 403) {
          gone("Another server is there now: open the address that it printed.");
          return;
        }
      } catch { /* still gone */ }
      connect();
    }, RETRY);
  };
}

function gone(text) {
  $("gone").textContent = text;
  $("gone").hidden = !text;
}

function send(message) {
  question += 1;
  if (talk.readyState === WebSocket.OPEN) talk.send(JSON.stringify({ id: question, ...message }));
  return question;
}

function receive(message) {
  if (message.type === "progress") progress(message);
  else if (message.type === "found") { found = ranked(found.concat(message.found)); list(); }
  else if (message.type === "opening") open(message.stamp);
  else if (message.type === "tried") tried(message);
  else if (message.type === "error") {
    if (message.id === question || message.id === asking) {
      $("answer").className = "missed";
      $("verdict").textContent = message.text;
    }
  } else if (message.id === asking) {
    if (message.type === "answer") answer(message);
    else if (message.type === "nothing") {
      $("answer").className = "";
      $("verdict").textContent = `Nothing can be asked about ${message.entity}.`;
    } else if (message.type === "hints") hints(message.hints);
  }
}

// --- questions and answers ----------------------------------------------------------------------

let asking = 0;
function ask(what) {
  if (state.time === null) return;
  asked = performance.now();
  $("answer").classList.add("busy");
  asking = send({ type: "ask", time: Number(state.time), set: state.flipped ? [] : state.set, ...what });
}

function answer(message) {
  const took = performance.now() - asked;
  state.pick = message.pick;
  remember();
  $("answer").className = message.reported ? "reported" : "missed";
  $("answer").dataset.took = took.toFixed(0);
  $("verdict").textContent = message.verdict;
  const parts = [message.name, `frame ${message.frame}`];
  if (message.distance !== null) parts.push(`${message.distance} m away`);
  $("where").textContent = `${parts.join(" · ")} · answered in ${(took / 1000).toFixed(2)} s`;
  $("chain").replaceChildren(...message.chain.map((step) => {
    const row = document.createElement("li");
    const stage = document.createElement("b");
    stage.textContent = `${step.stage}: `;
    row.append(stage, step.text);
    return row;
  }));
  $("hints").replaceChildren();
  if (!message.reported) $("hints").textContent = "Trying what would change it ...";
}

function hints(all) {
  $("hints").replaceChildren(...all.map((hint) => {
    const button = document.createElement("button");
    const effect = document.createElement("small");
    button.textContent = `try ${hint.settings.join(", ")}`;
    const also = Object.entries({ fixes: hint.fixed, adds: hint.added, "wrongly adds": hint.false, loses: hint.lost })
      .filter(([, names]) => names?.length).map(([what, names]) => `${what} ${names.join(", ")}`);
    effect.textContent = [hint.text, ...also].join("; ");
    button.append(effect);
    button.onclick = () => change(hint.settings);
    return button;
  }));
}

// --- other values -------------------------------------------------------------------------------

function change(settings) {
  state.undo.push(state.set);
  const keys = new Set(settings.map((one) => one.split("=")[0]));
  state.set = [...state.set.filter((one) => !keys.has(one.split("=")[0])), ...settings];
  state.flipped = false;
  changed();
}

function changed() {
  remember();
  $("changed").hidden = !state.set.length && !state.undo.length;
  $("changes").replaceChildren(...state.set.map((one) => {
    const row = document.createElement("li");
    row.textContent = one;
    return row;
  }));
  $("save").href = `/config.yaml?${new URLSearchParams(state.set.map((one) => ["set", one]))}`;
  showControls();
  attempt();
}

let trying = 0;
function attempt() {
  if (state.time === null) return;
  $("effect").textContent = "Running the stages ...";
  trying = send({ type: "try", time: Number(state.time), set: state.flipped ? [] : state.set });
  if (state.pick) ask({ pick: state.pick });
}

function tried(message) {
  if (message.id !== trying) return;
  const counts = (side) => {
    const names = Object.entries(side);
    return names.length ? names.map(([name, number]) => `${number} ${name}`).join(", ") : "no object";
  };
  const parts = [`${counts(message.before)} before, ${counts(message.after)} after`];
  if (message.fixed?.length) parts.push(`fixes ${message.fixed.join(", ")}`);
  if (message.broken?.length) parts.push(`loses ${message.broken.join(", ")}`);
  parts.push(`${message.new} new, ${message.gone} gone, ${message.changed} changed`);
  if (message.f1) parts.push(`F1 ${message.f1.map((one) => one ?? "–").join(" → ")}`);
  for (const failure of message.failures) parts.push(failure);
  $("effect").textContent = `${state.flipped ? "Before: " : ""}${parts.join("; ")}.`;
}

function showControls() {
  const words = $("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  const own = new Map(state.set.map((one) => [one.slice(0, one.indexOf("=")), one.slice(one.indexOf("=") + 1)]));
  const wanted = controls.filter((one) => own.has(one.key) || (words.length
    && words.every((word) => `${one.key} ${one.about} ${one.unit}`.toLowerCase().includes(word))));
  $("controls").replaceChildren(...wanted.map((one) => control(one, own)));
}

function control(one, own) {
  const row = document.createElement("div");
  row.className = own.has(one.key) ? "control changed" : "control";
  const label = document.createElement("label");
  const about = document.createElement("small");
  const input = document.createElement(one.kind === "choice" ? "select" : "input");
  const value = own.get(one.key) ?? (one.value ?? "");
  input.id = `control-${one.key}`;
  label.htmlFor = input.id;
  label.textContent = one.key;
  const low = one.low === undefined ? "" : `from ${one.low}`;
  const high = one.high === undefined ? "" : `up to ${one.high}`;
  about.textContent = [one.about, one.unit, `${low} ${high}`.trim(), `opened with ${one.value ?? "nothing"}`]
    .filter(Boolean).join("; ");
  if (one.kind === "choice") input.append(...one.choices.map((name) => new Option(name, name, false, name === value)));
  else if (one.kind === "switch") { input.type = "checkbox"; input.checked = String(value) === "true"; }
  else input.value = typeof value === "object" ? JSON.stringify(value) : value;
  if (one.kind === "whole" || one.kind === "number") { input.inputMode = "decimal"; }
  input.onchange = () => {
    const text = one.kind === "switch" ? String(input.checked) : input.value;
    change([`${one.key}=${text === "" ? "null" : text}`]);
  };
  row.append(label, input, about);
  return row;
}

// --- what is worth a look -----------------------------------------------------------------------

const order = { missed: 0, unmatched: 0, unnamed: 1, false: 2 };
const ranked = (all) => all.sort((a, b) => order[a.what] - order[b.what] || (a.distance ?? 99) - (b.distance ?? 99));
const listed = () => {
  if (!$("here").checked || state.time === null) return found;
  const near = (one) => Math.abs(Number(one.stamp) - Number(state.time)) < 2000;
  return found.filter(near);
};

function list() {
  const rows = listed();
  $("found-none").hidden = rows.length > 0;
  $("found-title").textContent = `Worth a look within 40 m: ${rows.length}`;
  $("found").replaceChildren(...rows.slice(0, SHOWN).map((one, row) => {
    const item = document.createElement("li");
    const button = document.createElement("button");
    const parts = [["time", seconds(one.stamp)], [one.what, one.what],
      ["", `${one.name}${one.distance === null ? "" : ` at ${one.distance} m`}${one.reason ? `: ${one.reason}` : ""}`]];
    for (const [kind, text] of parts) {
      const part = document.createElement("span");
      part.className = kind;
      part.textContent = text;
      button.append(part);
    }
    button.setAttribute("aria-current", row === current);
    button.onclick = () => go(row);
    item.append(button);
    return item;
  }));
}

const seconds = (stamp) => (opening === null ? "" : `${((Number(stamp) - Number(first)) / 1e9).toFixed(2)} s`);
let first = 0; // stamp that times in the list count from

function go(row) {
  const rows = listed();
  if (!rows.length) return;
  current = (row + rows.length) % rows.length;
  const one = rows[current];
  seek(one.stamp);
  state.time = one.stamp;
  for (const [n, button] of $("found").querySelectorAll("button").entries()) {
    button.setAttribute("aria-current", n === current);
  }
  $("found").children[current]?.scrollIntoView({ block: "nearest" });
  ask({ pick: one.pick });
}

// --- the address --------------------------------------------------------------------------------

function remember() {
  const parts = new URLSearchParams({ bag: state.bag });
  if (state.time !== null) parts.set("at", state.time);
  if (state.pick) parts.set("pick", state.pick);
  for (const one of state.set) parts.append("set", one);
  history.replaceState(null, "", `${location.pathname}${location.search}#${parts}`);
}

const stated = new URLSearchParams(location.hash.slice(1));

function open(stamp) {
  if (opening !== null) return;
  const same = stated.get("bag") === state.bag;
  first = stamp;
  opening = (same && stated.get("at")) || stamp;
  state.time = opening;
  seek(opening);
  if (!same) return;
  state.set = stated.getAll("set");
  state.pick = stated.get("pick") ?? "";
  if (state.set.length) { state.undo.push([]); changed(); } else if (state.pick) ask({ pick: state.pick });
}

// --- what the run tells -------------------------------------------------------------------------

function welcome(message) {
  state.bag = message.bag;
  state.run = message.run;
  document.title = `${message.bag} · bevviz`;
  $("bag").textContent = message.bag;
  controls = message.controls;
  found = [];
  if (!message.detector) $("run").title = "no detector: give --model";
  showControls();
}

function progress(message) {
  $("bar").max = message.total || 1;
  $("bar").value = message.done;
  $("bar").hidden = message.over;
  const text = message.over ? `${message.done} frames` : `${message.done} of ${message.total} frames run`;
  $("run").textContent = [text, message.error, ...message.warnings].filter(Boolean).join(" · ");
  $("run").className = message.error ? "alarm" : "faint";
}

// --- keys and buttons ---------------------------------------------------------------------------

const actions = {
  n: () => go(current + 1),
  p: () => go(current - 1),
  u: () => { if (state.undo.length) { state.set = state.undo.pop(); changed(); } },
  b: () => { if (state.set.length) { state.flipped = !state.flipped; attempt(); } },
  "/": () => $("search").focus(),
};
$("next").onclick = actions.n;
$("previous").onclick = actions.p;
$("undo").onclick = actions.u;
$("flip").onclick = actions.b;
$("reset").onclick = () => { state.undo.push(state.set); state.set = []; state.flipped = false; changed(); };
$("copy").onclick = () => navigator.clipboard.writeText(state.set.map((one) => `--set '${one}'`).join(" "));
$("here").onchange = () => { current = -1; list(); };
$("search").oninput = showControls;
window.addEventListener("keydown", (event) => {
  const own = event.target.closest?.("aside"); // the viewer has inputs of its own, hidden ones
  const typing = own && ["INPUT", "SELECT"].includes(event.target.tagName);
  if (typing || event.ctrlKey || event.metaKey || event.altKey || !(event.key in actions)) return;
  event.preventDefault();
  event.stopPropagation();
  actions[event.key]();
}, true);

connect();
