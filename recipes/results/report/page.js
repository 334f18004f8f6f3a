"use strict";
// Draws the charts, and switches runs and axes. Plotly stands before this script.
const touch = matchMedia("(pointer: coarse)").matches;
const charts = JSON.parse(document.getElementById("charts").textContent);
const config = {
  responsive: true,
  displaylogo: false,
  displayModeBar: touch ? true : "hover",
  // Listed one by one, because some of Plotly's own send the chart to a server.
  modeBarButtons: [["toImage"], touch ? [] : ["zoom2d", "pan2d"], ["zoomIn2d", "zoomOut2d", "resetScale2d"]].filter(
    (group) => group.length,
  ),
};
const input = (id) => document.getElementById(id);
const isOn = (id) => input(id) === null || input(id).checked;

function isVisible({ group, run, kind }) {
  if (!isOn(`group-${group}`)) return false;
  if (kind === "episodes") return run === undefined || isOn(`run-${group}-${run}`);
  if (kind === "band") return isOn("bands");
  return kind !== "run" || (isOn("singles") && isOn(`run-${group}-${run}`));
}

function show() {
  for (const { element } of charts) {
    Plotly.restyle(element, { visible: element.data.map((trace) => isVisible(trace.meta)) });
  }
}

for (const chart of charts) {
  const element = (chart.element = document.getElementById(`chart-${chart.column}`));
  const { data, layout } = chart.figure;
  if (touch) {
    layout.dragmode = false; // a finger scrolls the page; the buttons zoom
    layout.margin.t = 40;
  }
  for (const trace of data) trace.visible = isVisible(trace.meta);
  chart.range = layout.yaxis.range;
  Plotly.newPlot(element, data, layout, { ...config, toImageButtonOptions: { filename: chart.column, scale: 2 } });
  const button = document.querySelector(`[data-log="${chart.column}"]`);
  button?.addEventListener("click", () => {
    const log = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", log);
    const range = log || !chart.range ? { "yaxis.autorange": true } : { "yaxis.range": chart.range };
    Plotly.relayout(element, { "yaxis.type": log ? "log" : "linear", ...range });
  });
}

for (const box of document.querySelectorAll(".switches input")) {
  if (box.id === "log-steps") {
    box.addEventListener("change", () => {
      const type = box.checked ? "log" : "linear";
      for (const { column, element } of charts) {
        if (column !== "evaluation-episodes") Plotly.relayout(element, { "xaxis.type": type, "xaxis.autorange": true });
      }
    });
  } else {
    box.addEventListener("change", show);
  }
}

// Paper is narrower than most windows.
addEventListener("beforeprint", () => {
  for (const details of document.querySelectorAll("details.prints")) details.open = true;
  for (const { element } of charts) {
    const wide = element.closest(".wide") !== null;
    Plotly.relayout(element, { autosize: false, width: wide ? 700 : 338, height: wide ? 330 : 210 });
  }
});
addEventListener("afterprint", () => {
  for (const { element } of charts) {
    Plotly.relayout(element, { autosize: true, width: null, height: null });
  }
});
document.documentElement.dataset.ready = "true";
