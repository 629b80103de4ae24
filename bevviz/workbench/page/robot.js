// Panel of a running robot: hold a frame, follow the newest one, save the flight recorder, mark a frame.

const RETRY = 1500; // ms between attempts to reach the server
const panel = document.createElement("section");
panel.id = "live";
panel.innerHTML = `<h2>The robot</h2><p id="said" class="faint" role="status">At the newest frame.</p>
<p class="buttons"><button id="hold" title="H">hold this frame</button><button id="follow" title="F">follow</button>
<button id="snap" title="S">save what was seen</button></p>
<p class="buttons"><input id="mark-text" placeholder="a note" aria-label="a note" size="24">
<button id="mark" title="M">mark this frame</button></p>`;
document.querySelector("aside header").after(panel);
for (const id of ["drive", "flip"]) document.getElementById(id).hidden = true; // These need a recorded drive.
document.getElementById("words").closest("section").hidden = true;
const $ = (id) => document.getElementById(id);

let time = null; // of the viewer, nanoseconds
let newest = null;
window.addEventListener("viewer-event", ({ detail }) => {
  if (detail.type === "time_update") time = detail.time;
  if (time !== null && (newest === null || time > newest)) newest = time;
});
const toViewer = (detail) => window.dispatchEvent(new CustomEvent("to-viewer", { detail }));
const go = (stamp, play) => toViewer({ type: "time_ctrl", timeline: "stamp", timestamp_nanos: stamp, play });

let socket = null;
function connect() {
  socket = new WebSocket(`ws://${location.host}/live`);
  socket.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.type === "held") {
      say(`Frame ${message.frame} is held: ask about it.`);
      go(message.stamp, false);
    } else say(message.text, message.wrong);
  };
  socket.onclose = () => setTimeout(connect, RETRY);
}

function say(text, wrong) {
  $("said").textContent = text;
  $("said").className = wrong ? "alarm" : "faint";
}

const order = (what) => { if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(what)); };
const actions = {
  h: () => { if (time !== null) order({ type: "hold", time }); },
  f: () => { say("At the newest frame."); if (newest !== null) go(String(BigInt(Math.round(newest))), true); },
  s: () => { say("Saving ..."); order({ type: "snap" }); },
  m: () => {
    if (time !== null) order({ type: "mark", time, text: $("mark-text").value });
    $("mark-text").value = "";
  },
};
for (const [id, key] of [["hold", "h"], ["follow", "f"], ["snap", "s"], ["mark", "m"]]) $(id).onclick = actions[key];
window.addEventListener("keydown", (event) => {
  const typing = event.target.closest?.("aside") && ["INPUT", "SELECT"].includes(event.target.tagName);
  if (event.key === "Enter" && event.target.id === "mark-text") actions.m();
  if (typing || event.ctrlKey || event.metaKey || event.altKey || !(event.key in actions)) return;
  event.preventDefault();
  event.stopPropagation();
  actions[event.key]();
}, true);
connect();
