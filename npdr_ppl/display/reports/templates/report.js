"use strict";
(() => {
  // A link to a folded section unfolds it.
  const unfold = () => {
    const target = location.hash && document.getElementById(location.hash.slice(1));
    const heading = target && target.querySelector("summary > h2");
    if (heading) heading.closest("details").open = true;
  };
  addEventListener("hashchange", unfold);
  unfold();

  const source = document.getElementById("charts");
  if (!source) return;
  const charts = JSON.parse(source.textContent);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const shade = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  // Texts and axes take the page's colours; a trace with the meta "ink" is drawn in that of text.
  const themed = (layout) => {
    const copy = structuredClone(layout);
    const axis = { gridcolor: shade("--line"), linecolor: shade("--line"), zerolinecolor: shade("--line") };
    for (const name of Object.keys(copy)) {
      if (/^[xy]axis/.test(name)) Object.assign(copy[name], axis);
    }
    return Object.assign(copy, {
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", autosize: true,
      font: { color: shade("--ink"), family: "system-ui, sans-serif", size: 12 },
      hoverlabel: { bgcolor: shade("--raised"), font: { color: shade("--ink") } },
    });
  };
  const inked = (data) => structuredClone(data).map((trace) => {
    if (trace.meta === "ink") {
      trace.line = Object.assign(trace.line || {}, { color: shade("--ink") });
      trace.marker = Object.assign(trace.marker || {}, { color: shade("--ink") });
    }
    return trace;
  });
  const draw = (element) => {
    const { data, layout } = charts[element.dataset.chart];
    const options = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["lasso2d", "select2d"] };
    Plotly.react(element, inked(data), themed(layout), options);
  };
  const all = () => [...document.querySelectorAll("[data-chart]")];
  const drawAll = () => all().forEach(draw);
  drawAll();
  dark.addEventListener("change", drawAll);
  // Inside what is folded a chart has no width; on paper it has another one, and is black on white.
  const resize = (charts) => charts.filter((c) => c.offsetWidth).forEach((c) => Plotly.Plots.resize(c));
  document.querySelectorAll("details").forEach((details) => details.addEventListener("toggle", () => {
    resize([...details.querySelectorAll("[data-chart]")]);
  }));
  window.matchMedia("print").addEventListener("change", () => { drawAll(); resize(all()); });
})();
