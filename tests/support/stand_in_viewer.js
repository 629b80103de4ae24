// Stand-in for Rerun's viewer in tests of the page: it draws nothing, and goes at once where the page sends it.
// As the viewer does, it opens with the first data at its start, and reports a time only where it differs.

function render({ model }) {
  const tell = (event) => setTimeout(() => model.send(JSON.stringify(event)));
  let isOpen = false;
  let timeline = null;
  let time = null;
  function go(toTimeline, toTime) {
    const changes = { timeline: timeline !== toTimeline, time: time !== toTime };
    [timeline, time] = [toTimeline, toTime];
    if (changes.timeline) tell({ type: "timeline_change", timeline, time });
    if (changes.time) tell({ type: "time_update", time });
  }
  model.on("msg:custom", (message) => {
    if (message.type === "rrd" && !isOpen) {
      isOpen = true;
      tell({ type: "recording_open" });
      go("stamp", 0);
    }
    if (message.type === "time_ctrl" && isOpen) go(message.timeline, Number(message.timestamp_nanos));
  });
  window.clickInViewer = (item) => tell({ type: "selection_change", items: [{ type: "entity", ...item }] });
  setTimeout(() => model.send("ready"));
}

export default { render };
