// Connection to the server: send questions, receive answers and recordings, reconnect.

import { nextPicture } from "./idle_drawing.js";
import { $, state } from "./page_state.js";
import { kind, toViewer, viewerReady } from "./viewer.js";

const RETRY = 1500; // ms between attempts to reach the server

let questions = null; // socket of the questions and answers
let number = 0; // of the newest question
const handlers = {};
const failures = new Map(); // what to do with the error of a message, by its number
export const on = (more) => Object.assign(handlers, more);

const socketAt = (path) => new WebSocket(`ws://${location.host}${path}`);
const pieces = { film: 0, desk: 0 }; // number of pieces that the viewer has received of each recording
let early = 0; // number of frames that were requested out of order
let recordings = []; // sockets: film (the run), then desk (answers and tried results; a robot has none)

// Request the frame of this stamp next, if the viewer does not have it yet.
export function want(stamp) {
  if (recordings[0]?.readyState !== WebSocket.OPEN) return;
  early += 1;
  recordings[0].send(String(stamp));
}

function receive(lane) {
  const first = pieces[lane] - Math.min(pieces[lane], lane === "film" ? early : 0);
  const socket = socketAt(`/film?lane=${lane}&from=${first}`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = ({ data }) => {
    if (!pieces.film) performance.mark("piece");
    pieces[lane] += 1;
    toViewer({ type: "rrd" }, [new DataView(data)]);
    for (const one of awaited.filter(([, count]) => pieces.desk >= count)) one[0]();
    awaited = awaited.filter(([, count]) => pieces.desk < count);
    if (recordings.length === 1 && kind !== "live") recordings.push(receive("desk")); // The layout has to arrive first.
    if (lane === "film") nextPicture(() => { if (socket.readyState === WebSocket.OPEN) socket.send(""); });
  };
  if (kind === "live") { // A page in the background draws nothing, and does not count as slow.
    socket.onopen = () => { if (document.hidden) socket.send("hidden"); };
  }
  return socket;
}
document.addEventListener("visibilitychange", () => {
  if (kind === "live" && recordings[0]?.readyState === WebSocket.OPEN) {
    recordings[0].send(document.hidden ? "hidden" : "seen");
  }
});

export function connect() {
  questions = socketAt("/talk");
  questions.onopen = () => { alarm(""); };
  questions.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.type === "welcome") {
      if (state.run && state.run !== message.run) { location.reload(); return; }
      handlers.welcome(message);
      viewerReady.then(() => { recordings = [receive("film")]; });
    } else if (message.type === "failed") alarm(message.text);
    else if (message.type === "error") (failures.get(message.id) ?? handlers.error)(message);
    else handlers[message.type]?.(message);
  };
  questions.onclose = () => {
    for (const socket of recordings) socket.close();
    handlers.gone?.();
    if (!$("gone").textContent) alarm("The server is gone: nothing is answered until it is back. Looking for it ...");
    setTimeout(async () => {
      try {
        const answer = await fetch("/page/panel.js", { method: "HEAD", cache: "no-store" });
        if (answer.status === 403) alarm("Another server is there now: open the address that it printed.");
      } catch { /* The server is still gone. */ }
      connect();
    }, RETRY);
  };
}

function alarm(text) {
  $("gone").textContent = text;
  $("gone").hidden = !text;
}

// Send a message. An error in reply to it goes to `failed`, which names the thing that it is about.
export function send(message, failed) {
  number += 1;
  if (failed) failures.set(number, failed);
  failures.delete(number - 100);
  if (questions.readyState === WebSocket.OPEN) questions.send(JSON.stringify({ id: number, ...message }));
  return number;
}


// Call a function once the viewer has so many pieces of the desk.
let awaited = [];
export function withPieces(count, then) {
  if (pieces.desk >= count) then();
  else awaited.push([then, count]);
}
