// Connection to the server: send questions, receive answers and recordings, reconnect.

import { nextPicture } from "./idle_drawing.js";
import { $, state } from "./page_state.js";
import { kind, toViewer, viewerReady } from "./viewer.js";

const RETRY = 1500; // ms between attempts to reach the server

let talk = null;
let question = 0; // number of the newest question
const handlers = {};
export const on = (more) => Object.assign(handlers, more);

const socketAt = (path) => new WebSocket(`ws://${location.host}${path}`);
const pieces = { film: 0, desk: 0 }; // number of pieces that the viewer has received
let early = 0; // number of frames that were requested out of order
let lanes = [];

// Request the frame of this stamp next, if the viewer does not have it yet.
export function want(stamp) {
  if (lanes[0]?.readyState !== WebSocket.OPEN) return;
  early += 1;
  lanes[0].send(String(stamp));
}

function film(lane) {
  const socket = socketAt(`/film?lane=${lane}&from=${pieces[lane] - Math.min(pieces[lane], lane === "film" ? early : 0)}`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = ({ data }) => {
    if (!pieces.film) performance.mark("piece");
    pieces[lane] += 1;
    toViewer({ type: "rrd" }, [new DataView(data)]);
    if (lanes.length === 1) lanes.push(film("desk")); // The layout has to arrive first.
    if (lane === "film") nextPicture(() => { if (socket.readyState === WebSocket.OPEN) socket.send(""); });
  };
  if (lane === "film" && kind === "live") { // A page in the background draws nothing, and does not count as slow.
    socket.onopen = () => { if (document.hidden) socket.send("hidden"); };
  }
  return socket;
}
document.addEventListener("visibilitychange", () => {
  if (kind === "live" && lanes[0]?.readyState === WebSocket.OPEN) lanes[0].send(document.hidden ? "hidden" : "seen");
});

export function connect() {
  talk = socketAt("/talk");
  talk.onopen = () => { gone(""); };
  talk.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.type === "welcome") {
      if (state.run && state.run !== message.run) { location.reload(); return; }
      handlers.welcome(message);
      viewerReady.then(() => { lanes = [film("film")]; });
    } else if (message.type === "failed") gone(message.text);
    else handlers[message.type]?.(message);
  };
  talk.onclose = () => {
    for (const lane of lanes) lane.close();
    if (!$("gone").textContent) gone("The server is gone: nothing is answered until it is back. Looking for it ...");
    setTimeout(async () => {
      try {
        const answer = await fetch("/page/panel.js", { method: "HEAD", cache: "no-store" });
        if (answer.status === 403) gone("Another server is there now: open the address that it printed.");
      } catch { /* The server is still gone. */ }
      connect();
    }, RETRY);
  };
}

function gone(text) {
  $("gone").textContent = text;
  $("gone").hidden = !text;
}

export function send(message) {
  question += 1;
  if (talk.readyState === WebSocket.OPEN) talk.send(JSON.stringify({ id: question, ...message }));
  return question;
}

export const newest = () => question;
