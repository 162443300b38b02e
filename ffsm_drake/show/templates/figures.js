"use strict";
(() => {
  const { template, figures } = JSON.parse(document.getElementById("figures").textContent);
  const places = [...document.querySelectorAll("[data-figure]")];
  const inSight = new Set();
  const stale = new Set(places);
  const hidden = new Set(); // runs that are switched off
  let range = null; // of all time axes

  // Draws a figure, or brings it up to date; what is out of sight waits until it comes into sight.
  function update(place) {
    if (!stale.delete(place)) return;
    const { data, layout } = figures[place.dataset.figure];
    const visible = data.map((trace) => !hidden.has(trace.legendgroup));
    const timed = place.dataset.kind === "time";
    if (place.data) {
      const axis = timed ? (range ? { "xaxis.range": [...range] } : { "xaxis.autorange": true }) : {};
      Plotly.update(place, { visible }, axis);
      return;
    }
    data.forEach((trace, k) => { trace.visible = visible[k]; });
    if (timed && range) layout.xaxis.range = [...range];
    if (matchMedia("(pointer: coarse)").matches && !layout.scene) layout.dragmode = false;
    const buttons = layout.scene ? ["toImage", "resetCameraDefault3d"] : ["toImage", "resetScale2d"];
    Plotly.newPlot(place, data, { ...layout, template }, { displaylogo: false, modeBarButtons: [buttons] });
    if (timed) place.on("plotly_relayout", (change) => zoomed(place, change));
  }

  function zoomed(place, change) {
    if ("xaxis.range[0]" in change) range = [change["xaxis.range[0]"], change["xaxis.range[1]"]];
    else if (change["xaxis.autorange"]) range = null;
    else return;
    refresh(places.filter((other) => other !== place && other.dataset.kind === "time"));
  }

  function refresh(changed) {
    changed.forEach((place) => stale.add(place));
    inSight.forEach(update);
  }

  const sight = new IntersectionObserver((entries) => entries.forEach(({ target, isIntersecting }) => {
    inSight[isIntersecting ? "add" : "delete"](target);
    if (isIntersecting) update(target);
  }), { rootMargin: "600px" });
  const size = new ResizeObserver((entries) => entries.forEach(({ target }) => {
    if (target.data && target.offsetParent) Plotly.Plots.resize(target);
  }));
  places.forEach((place) => { sight.observe(place); size.observe(place); });

  document.querySelectorAll("[data-run]").forEach((chip) => chip.addEventListener("click", () => {
    const shown = hidden.delete(chip.dataset.run);
    if (!shown) hidden.add(chip.dataset.run);
    chip.setAttribute("aria-pressed", String(shown));
    refresh(places);
  }));

  // Paper shows every open view, at its own width.
  function fit(width) {
    places.filter((place) => place.offsetParent).forEach((place) => {
      update(place);
      Plotly.relayout(place, width ? { width: place.clientWidth } : { width: null, autosize: true });
    });
  }
  addEventListener("beforeprint", () => { document.documentElement.classList.add("printing"); fit(true); });
  addEventListener("afterprint", () => { document.documentElement.classList.remove("printing"); fit(false); });
})();
