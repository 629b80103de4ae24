// Connection to the server: send questions, receive answers and recordings, reconnect.

import { nextPicture } from "./rerun_patches.js";
import { $, state } from "./page_state.js";
import { kind, toViewer, viewerReady } from "./viewer.js";

const RETRY = 1500; // ms between attempts to reach the server
const LIMIT = 300e6; // bytes of frames on demand that the viewer holds, which take nearly three times the memory

/** @import { FromPage, ToPage, AnswerMessage, Error } from "./types" */
/** @typedef {ToPage | AnswerMessage} Message */
/** @typedef {{ [K in Message["type"]]: (message: Extract<Message, { type: K }>) => void }} Handlers */
/** @typedef {FromPage extends infer M ? M extends FromPage ? Omit<M, "id"> : never : never} Sent a message without its number */
/** @typedef {{ made: (frame: number) => void, full: () => void, gone: () => void }} Happenings a frame came; no more is held; no server */

/** @type {WebSocket | null} */
let questions = null; // socket of the questions and answers
let number = 0; // of the newest question
/** @type {Partial<Handlers & Happenings>} */
const handlers = {};
/** @type {Map<number, (message: Error) => void>} */
const failures = new Map(); // what to do with the error of a message, by its number
export const on = (/** @type {Partial<Handlers & Happenings>} */ more) => Object.assign(handlers, more);

const socketAt = (/** @type {string} */ path) => new WebSocket(`ws://${location.host}${path}`);
const pieces = new Map(); // number of pieces that the viewer has received of each recording
const counted = (/** @type {string} */ lane) => pieces.get(lane) ?? 0;
let early = 0; // number of frames that were requested out of order
let held = 0; // bytes of frames on demand that the viewer holds
/** @type {WebSocket | null} */
let recording = null; // socket of the run
let overlay = ""; // name of this page's answers and tried results; a robot has none
/** @type {Map<string, WebSocket>} */
const others = new Map(); // sockets of the overlay, and of runs with other values

/**
 * Request the frame of this stamp next, if the viewer does not have it yet.
 * @param {string | null} stamp
 */
export function want(stamp) {
  if (recording?.readyState !== WebSocket.OPEN) return;
  if (!state.demand) early += 1;
  recording.send(String(stamp));
}

/**
 * Receive the recording of a run with other values, because its settings are shown.
 * @param {string} lane
 */
export function follow(lane) {
  if (counted("recording") && !others.has(lane)) others.set(lane, receive(lane)); // The layout has to arrive first.
}

/** @param {string} lane */
function receive(lane) {
  const first = counted(lane) - Math.min(counted(lane), lane === "recording" ? early : 0);
  const socket = socketAt(`/recording?lane=${lane}&from=${first}`);
  socket.binaryType = "arraybuffer";
  /** @type {number | null} */
  let announced = null; // number of the frame that comes next
  socket.onmessage = ({ data }) => {
    if (typeof data === "string") { announced = Number(data); return; }
    if (!counted("recording")) performance.mark("piece");
    toViewer({ type: "rrd" }, [new DataView(data)]);
    if (announced !== null) handlers.made?.(announced);
    if (announced === null || !state.demand) pieces.set(lane, counted(lane) + 1);
    else {
      held += data.byteLength;
      if (held > LIMIT) handlers.full?.();
    }
    announced = null;
    if (overlay) follow(overlay);
    if (!lane.startsWith("overlay")) nextPicture(() => { if (socket.readyState === WebSocket.OPEN) socket.send(""); });
  };
  if (lane === "recording" && state.demand) socket.onopen = () => want(state.time);
  if (kind === "live") { // A page in the background draws nothing, and does not count as slow.
    socket.onopen = () => { if (document.hidden) socket.send("hidden"); };
  }
  return socket;
}
document.addEventListener("visibilitychange", () => {
  if (kind === "live" && recording?.readyState === WebSocket.OPEN) {
    recording.send(document.hidden ? "hidden" : "seen");
  }
});

export function connect() {
  questions = socketAt("/talk");
  questions.onopen = () => { alarm(""); };
  questions.onmessage = ({ data }) => {
    /** @type {Message} */
    const message = JSON.parse(data);
    if (message.type === "welcome") {
      if (state.run && state.run !== message.run) { location.reload(); return; }
      handlers.welcome?.(message);
      overlay = message.overlay;
      viewerReady.then(() => { recording = receive("recording"); });
    } else if (message.type === "failed") alarm(message.text);
    else if (message.type === "error") (failures.get(message.id ?? 0) ?? handlers.error)?.(message);
    else /** @type {(message: Message) => void} */ (handlers[message.type])?.(message);
  };
  questions.onclose = () => {
    for (const socket of [recording, ...others.values()]) socket?.close();
    others.clear();
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

/** @param {string} text */
function alarm(text) {
  $("gone").textContent = text;
  $("gone").hidden = !text;
}

/**
 * Send a message. An error in reply to it goes to `failed`, which names the thing that it is about.
 * @param {Sent} message
 * @param {(message: Error) => void} [failed]
 */
export function send(message, failed) {
  number += 1;
  if (failed) failures.set(number, failed);
  failures.delete(number - 100);
  if (isConnected()) questions?.send(JSON.stringify({ id: number, ...message }));
  return number;
}

export const isConnected = () => questions?.readyState === WebSocket.OPEN;
