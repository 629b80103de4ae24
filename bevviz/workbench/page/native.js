// Stand-in for the widget: the viewer is a window of its own, and the server talks to it.

const RETRY = 1500; // ms between attempts to reach the server

function gone(again) {
  const said = document.createElement("p");
  const button = document.createElement("button");
  said.id = "viewer-gone";
  said.className = "alarm";
  said.setAttribute("role", "alert");
  said.textContent = "The viewer was closed. ";
  button.textContent = "open it again";
  button.onclick = () => { button.disabled = true; again(); };
  said.append(button);
  return said;
}

function render({ model }) {
  let socket = null;
  const waiting = [];
  const send = (message) => {
    if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
    else waiting.splice(0, waiting.length, message); // Only the newest time counts.
  };
  model.on("msg:custom", (message) => { if (message.type === "time_ctrl") send(message); });

  function connect() {
    socket = new WebSocket(`ws://${location.host}/native`);
    socket.onopen = () => { for (const message of waiting.splice(0)) send(message); };
    socket.onmessage = ({ data }) => {
      const event = JSON.parse(data);
      document.getElementById("viewer-gone")?.remove();
      if (event.type === "viewer_gone") {
        const said = gone(() => send({ type: "reopen" }));
        if (event.text) said.prepend(`${event.text}. `);
        document.querySelector("header").append(said);
      } else model.send(JSON.stringify(event));
    };
    socket.onclose = () => setTimeout(connect, RETRY);
  }
  connect();
  model.send("ready");
}

export default { render };
