"use strict";
const byId = (id) => document.getElementById(id);
const drawings = JSON.parse(byId("drawings").textContent);
const root = document.documentElement;
const plots = new Map();
let printing = false;

// Theme: the system's until the reader chooses.

const systemDark = matchMedia("(prefers-color-scheme: dark)");
const isDark = () => !printing && (root.dataset.theme ? root.dataset.theme === "dark" : systemDark.matches);

function colour(name) {
  return getComputedStyle(root).getPropertyValue("--" + name).trim();
}

function coloured(part) {
  if (typeof part === "string") return part.startsWith("@") ? colour(part.slice(1)) : part;
  if (Array.isArray(part)) return part.map(coloured);
  if (part && typeof part === "object" && !ArrayBuffer.isView(part)) {
    return Object.fromEntries(Object.entries(part).map(([key, value]) => [key, coloured(value)]));
  }
  return part;
}

function showTheme() {
  byId("theme").setAttribute("aria-pressed", String(isDark()));
  byId("theme").textContent = isDark() ? "Light" : "Dark";
}

byId("theme").addEventListener("click", () => {
  root.dataset.theme = isDark() ? "light" : "dark";
  try { localStorage.setItem("jaxgray-theme", root.dataset.theme); } catch { /* a file may not keep it */ }
  showTheme();
  redraw();
});
systemDark.addEventListener("change", () => { showTheme(); redraw(); });
showTheme();

// Series: 32-bit floats as text, evenly spaced numbers as first, step and count.

function series(packed) {
  if (packed && packed.f4 !== undefined) {
    const bytes = Uint8Array.from(atob(packed.f4), (letter) => letter.charCodeAt(0));
    return new Float32Array(bytes.buffer);
  }
  if (packed && packed.count !== undefined && packed.step !== undefined) {
    return Float64Array.from({ length: packed.count }, (_, k) => packed.first + k * packed.step);
  }
  return packed;
}

// A long series as its extremes in every bin of the range that is seen, at their true times.

function shown(trace, range, bins) {
  const { x, y, even } = trace;
  if (!even || y.length <= 2 * bins) return { x, y };
  const width = range ? range[1] - range[0] : 0;
  const place = (value) => Math.round((value - even.first) / even.step);
  const first = range ? Math.max(0, place(range[0] - width)) : 0;
  const last = range ? Math.min(y.length, place(range[1] + width) + 1) : y.length;
  const visible = range ? Math.max(1, width / even.step) : y.length;
  const stretch = Math.ceil(visible / bins);
  if (stretch <= 2) return { x: x.slice(first, last), y: y.slice(first, last) };
  const points = { x: [], y: [] };
  for (let k = first; k < last; k += stretch) {
    let low = -1, high = -1;
    for (let j = k; j < Math.min(k + stretch, last); j++) {
      if (Number.isNaN(y[j])) continue;
      if (low < 0 || y[j] < y[low]) low = j;
      if (high < 0 || y[j] > y[high]) high = j;
    }
    if (low < 0) { points.x.push(x[k]); points.y.push(null); continue; }
    for (const j of low < high ? [low, high] : low > high ? [high, low] : [low]) {
      points.x.push(x[j]);
      points.y.push(y[j]);
    }
  }
  return points;
}

function prepared(drawing) {
  const traces = drawing.traces.map((trace) => {
    const even = trace.x && trace.x.step !== undefined && trace.x.count !== undefined ? trace.x : null;
    return { even, x: series(trace.x), y: series(trace.y), style: { ...trace, x: undefined, y: undefined } };
  });
  return { ...drawing, traces, range: drawing.layout.xaxis && drawing.layout.xaxis.range };
}

const bins = (element) => Math.max(200, Math.round(element.clientWidth * 0.9));

function tracesOf(plot) {
  const linear = !plot.layout.xaxis || plot.layout.xaxis.type !== "log";
  return plot.traces.map((trace) => ({
    type: "scatter",
    ...(trace.style.mode && !trace.style.hoverinfo ? { hovertemplate: "%{y:.5~g}" } : {}),
    ...coloured(trace.style),
    ...(linear ? shown(trace, plot.range, bins(plot.element)) : { x: trace.x, y: trace.y }),
  }));
}

function axisStyle(given) {
  return {
    automargin: true, gridcolor: colour("grid"), linecolor: colour("edge"), zerolinecolor: colour("grid"),
    exponentformat: "power", showexponent: "all", ...(given.type === "log" ? { dtick: given.range && given.range[1] - given.range[0] < 2.2 ? "D2" : 1, minor: { ticks: "outside" }, tickfont: { size: 10 } } : {}),
    ...given, title: { standoff: 6, ...given.title },
  };
}

function layoutOf(plot) {
  const layout = coloured(plot.layout);
  const narrow = plot.element.clientWidth < 520;
  for (const name of Object.keys(layout).filter((key) => /^[xy]axis/.test(key))) {
    const given = layout[name].title ? { ...layout[name], title: { ...layout[name].title } } : layout[name];
    layout[name] = axisStyle(given);
  }
  return {
    font: { family: "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif", size: narrow ? 11 : 12, color: colour("text") },
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", margin: { l: 52, r: 10, t: 8, b: 40 },
    legend: { orientation: "h", y: 1.0, yanchor: "bottom", x: 0, font: { size: narrow ? 11 : 12 } },
    hoverlabel: { bgcolor: colour("page"), bordercolor: colour("edge"), font: { color: colour("text") } },
    dragmode: matchMedia("(pointer: coarse)").matches || narrow ? false : "zoom",
    ...layout,
    width: plot.element.clientWidth, height: plot.element.clientHeight,
    // Otherwise the same arrays count as drawn already, and automatic ranges are not taken anew.
    datarevision: ++revision,
  };
}

let revision = 0;

const settings = {
  displaylogo: false, responsive: false, displayModeBar: matchMedia("(max-width: 760px)").matches ? false : "hover",
  // Named one by one: the library's own choice would offer to send the data away.
  modeBarButtons: [["toImage", "zoom2d", "pan2d", "resetScale2d"]],
};

function draw(plot) {
  const layout = layoutOf(plot);
  if (plot.range) layout.xaxis.range = [...plot.range];
  return Plotly.react(plot.element, tracesOf(plot), layout, settings);
}

// Linked axes: what is zoomed in one is zoomed in all of its group; the extremes are taken anew.

let linking = false;

function zoomed(plot, change) {
  if (linking) return;
  let range = null;
  if (change["xaxis.range[0]"] !== undefined) range = [change["xaxis.range[0]"], change["xaxis.range[1]"]];
  else if (change["xaxis.range"]) range = change["xaxis.range"];
  else if (change["xaxis.autorange"]) range = plot.home;
  if (!range) return;
  linking = true;
  const group = plot.linked ? [...plots.values()].filter((one) => one.linked === plot.linked) : [plot];
  const all = group.map((one) => { one.range = range.map(Number); return draw(one); });
  Promise.all(all).finally(() => { linking = false; });
}

function redraw() {
  for (const plot of plots.values()) if (plot.drawn) draw(plot);
}

async function drawAll() {
  for (const drawing of drawings) {
    const plot = { ...prepared(drawing), element: byId("plot-" + drawing.name) };
    plot.home = plot.range;
    plots.set(drawing.name, plot);
    await draw(plot);
    plot.drawn = true;
    plot.element.on("plotly_relayout", (change) => zoomed(plot, change));
    root.dataset.drawn = plots.size;
    await new Promise((next) => setTimeout(next));
  }
  root.dataset.ready = "yes";
}

let waiting = 0;
addEventListener("resize", () => { clearTimeout(waiting); waiting = setTimeout(() => { if (!printing) redraw(); }, 150); });

// Print: in light colours, as wide as the paper, with everything unfolded.

addEventListener("beforeprint", () => {
  printing = true;
  const theme = root.dataset.theme;
  root.dataset.theme = "light";
  root.dataset.before = theme || "";
  for (const part of document.querySelectorAll("details:not([open])")) { part.open = true; part.dataset.folded = "yes"; }
  for (const drawing of document.querySelectorAll(".shapes svg")) pose(drawing, 1);
  for (const plot of plots.values()) {
    const half = plot.element.parentElement.classList.contains("half");
    plot.element.style.width = half ? "335px" : plot.element.parentElement.classList.contains("third") ? "220px" : "690px";
  }
  redraw();
});
addEventListener("afterprint", () => {
  printing = false;
  if (root.dataset.before) root.dataset.theme = root.dataset.before; else delete root.dataset.theme;
  for (const part of document.querySelectorAll("details[data-folded]")) { part.open = false; delete part.dataset.folded; }
  for (const plot of plots.values()) plot.element.style.width = "";
  redraw();
});
byId("print").addEventListener("click", () => print());

// Mode shapes swing while they are seen, unless the reader wants no motion or prints.

const still = matchMedia("(prefers-reduced-motion: reduce)");
const seen = new Set();
let swinging = false;
const watch = new IntersectionObserver((entries) => {
  for (const entry of entries) entry.isIntersecting ? seen.add(entry.target) : seen.delete(entry.target);
  if (seen.size && !still.matches && !swinging) { swinging = true; requestAnimationFrame(swing); }
});

function pose(drawing, phase) {
  const line = drawing.querySelector("polyline");
  const values = drawing.dataset.shape.split(" ").map(Number);
  const height = (value) => -44 * value * phase;
  line.setAttribute("points", values.map((value, k) => `${36 + 72 * k},${height(value)}`).join(" "));
  drawing.querySelectorAll("circle").forEach((circle, k) => circle.setAttribute("cy", height(values[k])));
}

function swing(now) {
  for (const drawing of seen) pose(drawing, printing ? 1 : Math.cos((2 * Math.PI * now) / 1000 / drawing.dataset.period));
  swinging = seen.size > 0 && !still.matches;
  if (swinging) requestAnimationFrame(swing);
}

for (const drawing of document.querySelectorAll(".shapes svg")) watch.observe(drawing);

// Tables and the result, to take away.

async function copy(text) {
  try { await navigator.clipboard.writeText(text); return; } catch { /* not allowed for a file: the old way */ }
  const area = Object.assign(document.createElement("textarea"), { value: text });
  document.body.append(area);
  area.select();
  document.execCommand("copy");
  area.remove();
}

const cellText = (cell) => cell.innerHTML.replace(/<br>/g, "; ").replace(/&amp;/g, "&").replace(/&lt;/g, "<").replace(/&gt;/g, ">").trim();

for (const button of document.querySelectorAll("button.copy")) {
  button.addEventListener("click", async () => {
    const rows = button.parentElement.querySelectorAll("tr");
    await copy([...rows].map((row) => [...row.cells].map(cellText).join("\t")).join("\n") + "\n");
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  });
}

byId("download").addEventListener("click", () => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([byId("document").textContent], { type: "application/json" }));
  link.download = "result.json";
  link.click();
  URL.revokeObjectURL(link.href);
});

for (const scroller of document.querySelectorAll(".scroller")) {
  // Only what can be scrolled is a stop on the way of the tab key.
  const update = () => {
    if (scroller.scrollWidth > scroller.clientWidth + 1) {
      scroller.tabIndex = 0;
      scroller.setAttribute("role", "region");
      scroller.setAttribute("aria-label", scroller.querySelector("caption").textContent);
    } else scroller.removeAttribute("tabindex");
  };
  new ResizeObserver(update).observe(scroller);
}

// The library comes compressed.

async function start() {
  if (!byId("library") || !drawings.length) { root.dataset.ready = "yes"; return; }
  const bytes = Uint8Array.from(atob(byId("library").textContent), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(stream).text();
  document.head.append(script);
  await drawAll();
}

start().catch((error) => {
  byId("trouble").textContent = "The plots could not be drawn in this browser (" + error.message + "); the tables hold every number.";
  byId("trouble").hidden = false;
});
