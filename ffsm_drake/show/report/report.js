"use strict";
(() => {
  const data = JSON.parse(document.getElementById("plot-data").textContent);
  const root = document.documentElement;
  const panels = [];
  const state = { time: null, hidden: new Set(), version: 1, printing: false };
  const decoded = new Map();

  function numbers(index) {
    if (!decoded.has(index)) {
      const text = atob(data.arrays[index]);
      const bytes = Uint8Array.from(text, (character) => character.charCodeAt(0));
      const view = new DataView(bytes.buffer);
      decoded.set(index, Array.from({ length: bytes.length / 4 }, (_, k) => view.getFloat32(4 * k, true)));
    }
    return decoded.get(index);
  }

  // plotly.js reads a few tags in labels: none of them may come from a scenario.
  const escaped = (text) => text.replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");

  function colors() {
    const style = getComputedStyle(root);
    const of = (name) => style.getPropertyValue(name).trim();
    return { dark: !state.printing && of("--dark") === "1", ink: of("--ink"), soft: of("--soft"), line: of("--line"), paper: of("--card"), band: of("--band") };
  }

  // On dark ground a little lighter, as report.css does with its swatches.
  function tinted(paint, color) {
    if (!color.dark) return paint;
    const parts = [1, 3, 5].map((k) => parseInt(paint.slice(k, k + 2), 16));
    return `#${parts.map((part) => Math.round(part + 0.25 * (255 - part)).toString(16).padStart(2, "0")).join("")}`;
  }

  function traceOf(trace, panel, color) {
    const run = trace.run === undefined ? null : data.runs[trace.run];
    const paint = trace.ink ? color.soft : trace.color || run ? tinted(trace.color || run.color, color) : color.ink;
    const named = trace.name === undefined ? "" : trace.name;
    const several = run && data.runs.length > 1;
    const whole = several && named && panel.kind !== "map" ? `${run.label}, ${named}` : named || (run ? run.label : "");
    const name = escaped(whole);
    const shape = trace.step ? "hv" : "linear";
    const line = { color: paint, width: trace.width || 1.4, dash: trace.dash || "solid", shape };
    const visible = trace.run === undefined || !state.hidden.has(trace.run);
    const common = { name, visible, showlegend: Boolean(panel.legend), line, opacity: trace.faint ? 0.22 : 1 };
    if (trace.faint) common.hoverinfo = "skip";
    if (panel.kind === "space") {
      const [x, y, z] = [trace.x, trace.y, trace.z].map(numbers);
      const width = trace.ink ? 3 : 5;
      const hovertemplate = "x %{x:.4~g} m<br>y %{y:.4~g} m<br>z %{z:.4~g} m";
      if (trace.ends) {
        return { ...common, type: "scatter3d", mode: "markers+text", x, y, z, hovertemplate, text: ["start", "end"],
          textposition: "top center", textfont: { color: color.ink }, name: "",
          marker: { color: color.ink, size: 4, symbol: ["circle", "diamond"] } };
      }
      return { ...common, type: "scatter3d", mode: "lines", x, y, z, hovertemplate,
        line: { color: paint, width, dash: trace.ink ? "dash" : "solid" } };
    }
    let y = numbers(trace.y);
    if (panel.log) y = y.map((value) => (value === 0 ? null : Math.abs(value)));
    const x = numbers(trace.x);
    if (trace.marker) {
      const marker = { color: paint, size: 11, symbol: trace.marker, line: { color: color.paper, width: 1.5 } };
      return { ...common, type: "scatter", mode: "markers", x, y, marker };
    }
    // A curve of one point has no line to draw.
    const mode = x.length === 1 ? "markers" : "lines";
    const fill = trace.below ? { fill: "tozeroy", fillcolor: `${paint}1c` } : {};
    return { ...common, ...fill, type: "scatter", mode, x, y, marker: { color: paint, size: 6 } };
  }

  function layoutOf(panel, width, color) {
    const font = { family: getComputedStyle(document.body).fontFamily, size: 11.5, color: color.soft };
    const hoverlabel = { bgcolor: color.paper, bordercolor: color.line, font: { ...font, color: color.ink } };
    const coarse = matchMedia("(pointer: coarse)").matches;
    const modebar = { bgcolor: "rgba(0,0,0,0)", color: color.soft, activecolor: color.ink };
    const common = { width, height: panel.height, font, hoverlabel, modebar, showlegend: false,
      dragmode: coarse ? false : "zoom",
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)" };
    const unit = panel.axis === "1" ? "" : panel.axis;
    if (panel.kind === "space") {
      const axis = (name) => ({ title: { text: `${name} [m]` }, color: color.soft, gridcolor: color.line,
        zerolinecolor: color.line, showbackground: false, showspikes: false, nticks: 6 });
      const eye = { x: 1.55, y: -1.75, z: 0.95 };
      return { ...common, margin: { l: 0, r: 0, t: 0, b: 0 }, dragmode: "turntable",
        scene: { xaxis: axis("x"), yaxis: axis("y"), zaxis: axis("z"), aspectmode: "data", camera: { eye } } };
    }
    const axis = { gridcolor: color.line, linecolor: color.line, zerolinecolor: color.line, zerolinewidth: 1,
      automargin: true, ticks: "", title: { standoff: 6 } };
    const xaxis = { ...axis, title: { text: panel.x_title || "time [s]", standoff: 6 }, showgrid: panel.kind === "map" };
    if (panel.kind === "time") {
      if (state.time) xaxis.range = state.time.slice();
      Object.assign(xaxis, { hoverformat: ".4~g", unifiedhovertitle: { text: "%{x} s" } });
    } else if (panel.x) {
      xaxis.range = panel.x.slice();
    }
    const yaxis = { ...axis, title: { text: unit, standoff: 4 }, hoverformat: ".4~g", exponentformat: "power",
      showexponent: "all", nticks: 6 };
    if (panel.log) {
      const sizes = panel.traces.flatMap((trace) => numbers(trace.y)).map(Math.abs).filter((value) => value > 0);
      const decades = sizes.length ? Math.log10(sizes.reduce((a, b) => Math.max(a, b))
        / sizes.reduce((a, b) => Math.min(a, b))) : 0;
      yaxis.type = "log";
      // Between decades a tick is labelled only where there are few of them.
      if (decades > 1.5) yaxis.dtick = Math.ceil(decades / 6);
    }
    const range = panel.y || panel.range;
    if (range) yaxis.range = range.slice();
    const shapes = (panel.lines || []).map((line) => ({ type: "line", xref: "paper", x0: 0, x1: 1, y0: line.y, y1: line.y,
      line: { color: color.ink, width: 1.2 } }));
    if (panel.band) {
      shapes.push({ type: "rect", yref: "paper", y0: 0, y1: 1, x0: panel.band[0], x1: panel.band[1], layer: "below",
        fillcolor: color.band, line: { width: 0 } });
    }
    const annotations = (panel.lines || []).map((line) => ({ xref: "paper", x: 1, xanchor: "right", y: line.y,
      yanchor: "bottom", text: escaped(line.text), showarrow: false, font: { ...font, color: color.ink } }));
    const margin = { l: 44, r: 8, t: 8, b: 34 };
    const legend = { orientation: "h", x: 0, y: -0.22, yanchor: "top", itemclick: false, itemdoubleclick: false };
    return { ...common, showlegend: Boolean(panel.legend), legend, margin, hovermode: panel.kind === "map" ? "closest" : "x unified", xaxis, yaxis, shapes,
      annotations };
  }

  const buttons = (kind) => [kind === "space" ? ["toImage", "orbitRotation", "pan3d", "resetCameraDefault3d"]
    : ["toImage", "zoom2d", "pan2d", "resetScale2d"]];

  function draw(place) {
    const width = Math.floor(place.canvas.clientWidth);
    if (width < 20) return;  // out of sight, such as in a closed section
    const color = colors();
    const panel = { ...place.panel, x: place.x, y: place.y, height: place.canvas.clientHeight };
    const traces = panel.traces.map((trace) => traceOf(trace, panel, color));
    place.version = state.version;
    place.width = width;
    const drawing = place.drawn ? Plotly.react : Plotly.newPlot;
    drawing(place.canvas, traces, layoutOf(panel, width, color), { displaylogo: false, displayModeBar: true,
      modeBarButtons: buttons(panel.kind) });
    if (!place.drawn) {
      place.drawn = true;
      place.canvas.classList.remove("waiting");
      place.canvas.on("plotly_relayout", (change) => zoomed(place, change));
    }
  }

  function zoomed(place, change) {
    const range = (axis) => (change[`${axis}.range[0]`] !== undefined
      ? [change[`${axis}.range[0]`], change[`${axis}.range[1]`]] : change[`${axis}.range`]);
    const reset = (axis) => change[`${axis}.autorange`] === true;
    if (place.panel.kind === "space") return;
    if (range("yaxis")) place.y = range("yaxis");
    if (reset("yaxis")) place.y = null;
    if (place.panel.kind === "map") {
      if (range("xaxis")) place.x = range("xaxis");
      if (reset("xaxis")) place.x = null;
    } else if (range("xaxis")) {
      state.time = range("xaxis");
      refresh(place);
    } else if (reset("xaxis")) {
      state.time = null;
      refresh(place);
    }
    reveal();
  }

  // Only what is in sight is drawn at once; the rest follows while the browser is idle.
  function refresh(except) {
    state.version += 1;
    if (except) except.version = state.version;
    panels.filter((place) => place.visible && place.version !== state.version).forEach(draw);
    whenIdle();
  }

  let waiting = false;
  function whenIdle() {
    if (waiting) return;
    waiting = true;
    const later = window.requestIdleCallback || ((task) => setTimeout(task, 30));
    const work = () => {
      waiting = false;
      const next = panels.find((place) => place.version !== state.version && place.canvas.clientWidth >= 20);
      if (next) {
        draw(next);
        whenIdle();
      } else {
        root.dataset.plots = "drawn";
      }
    };
    // With a deadline, because a page in the background is never idle.
    later(work, { timeout: 200 });
  }

  function reveal() {
    const zoom = state.time !== null || panels.some((place) => place.y || place.x);
    document.querySelectorAll(".reset").forEach((button) => { button.hidden = !zoom; });
  }

  const sight = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      const place = panels.find((one) => one.canvas === entry.target);
      place.visible = entry.isIntersecting;
      if (place.visible && place.version !== state.version) draw(place);
    }
  }, { rootMargin: "200px" });

  function element(tag, className, text) {
    const made = document.createElement(tag);
    if (className) made.className = className;
    if (text !== undefined) made.textContent = text;
    return made;
  }

  function build(holder) {
    const plot = data.plots[holder.dataset.plot];
    const grid = element("div", "panels");
    if (plot.views.length > 1) {
      const tabs = element("div", "tabs");
      tabs.setAttribute("role", "group");
      plot.views.forEach((view, index) => {
        const tab = element("button", "tab", view.label);
        tab.type = "button";
        tab.setAttribute("aria-pressed", String(index === 0));
        tab.addEventListener("click", () => {
          tabs.querySelectorAll("button").forEach((one) => one.setAttribute("aria-pressed", String(one === tab)));
          show(grid, view);
        });
        tabs.append(tab);
      });
      holder.append(tabs);
    }
    holder.append(grid);
    show(grid, plot.views[0]);
  }

  function show(grid, view) {
    for (let k = panels.length - 1; k >= 0; k -= 1) {
      if (panels[k].grid === grid) {
        sight.unobserve(panels[k].canvas);
        Plotly.purge(panels[k].canvas);
        panels.splice(k, 1);
      }
    }
    grid.replaceChildren();
    grid.classList.toggle("wide", view.panels.some((panel) => panel.kind === "space" || panel.kind === "map"));
    let group = null;
    for (const panel of view.panels) {
      if (panel.group && panel.group !== group) {
        group = panel.group;
        grid.append(element("h3", "group", group));
      }
      const figure = element("figure", `panel ${panel.kind}`);
      figure.append(element("figcaption", "", panel.title));
      const canvas = element("div", "canvas waiting");
      figure.append(canvas);
      grid.append(figure);
      const place = { panel, canvas, grid, version: 0, drawn: false, visible: false, x: null, y: null };
      panels.push(place);
      sight.observe(canvas);
    }
    whenIdle();
  }

  document.querySelectorAll("[data-plot]").forEach(build);

  document.querySelectorAll("[data-run]").forEach((chip) => chip.addEventListener("click", () => {
    const run = Number(chip.dataset.run);
    const shown = !state.hidden.delete(run);
    if (shown) state.hidden.add(run);
    document.querySelectorAll(`[data-run="${run}"]`).forEach((one) => one.setAttribute("aria-pressed", String(!shown)));
    refresh();
  }));

  document.querySelectorAll(".reset").forEach((button) => button.addEventListener("click", () => {
    state.time = null;
    panels.forEach((place) => { place.x = null; place.y = null; });
    reveal();
    refresh();
  }));

  document.querySelectorAll("details").forEach((one) => one.addEventListener("toggle", whenIdle));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => refresh());

  let resizing = 0;
  addEventListener("resize", () => {
    clearTimeout(resizing);
    resizing = setTimeout(() => {
      if (!state.printing && panels.some((place) => place.width !== Math.floor(place.canvas.clientWidth))) refresh();
    }, 150);
  });

  // Paper is light and narrow, and shows everything.
  addEventListener("beforeprint", () => {
    state.printing = true;
    root.classList.add("printing");
    state.version += 1;
    panels.forEach(draw);
  });
  addEventListener("afterprint", () => {
    state.printing = false;
    root.classList.remove("printing");
    refresh();
  });

  const recording = document.getElementById("recording-text");
  if (recording) {
    const stage = document.getElementById("recording-stage");
    stage.querySelector("button").addEventListener("click", () => {
      const frame = element("iframe");
      frame.title = "Recording of the motion";
      frame.setAttribute("sandbox", "allow-scripts");
      frame.srcdoc = JSON.parse(recording.textContent);
      stage.replaceChildren(frame);
    });
  }
})();
