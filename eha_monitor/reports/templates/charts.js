// Draws the charts of a page when they come near the screen, over the pictures that stay for
// printers and for browsers without scripts.  Charts whose x axis is the recording's time share a
// cursor; those that show the same stretch of it share their zoom.
(() => {
  "use strict";
  const charts = new Map();   // element -> {clock, range, live}
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const finger = matchMedia("(pointer: coarse)").matches;
  // Light -> dark: ink, grid, paper, and Okabe and Ito's blues and browns made brighter.
  const NIGHT = {
    "#22303c": "#dfe6ec", "34,48,60": "223,230,236", "#ffffff": "#151b21",
    "255,255,255": "21,27,33", "#0072b2": "#56b4e9", "0,114,178": "86,180,233",
    "#8a6100": "#e69f00", "#a3150b": "#ff8a75", "163,21,11": "255,138,117",
    "#5b6873": "#a9b5bf", "91,104,115": "169,181,191", "#b4bcc4": "#66727d",
    "#d55e00": "#f08a3c", "213,94,0": "240,138,60"};
  let library = null, busy = false, pending = null;

  const unpack = async text => {
    const bytes = Uint8Array.from(atob(text.trim()), one => one.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  };

  const load = () => library ??= (async () => {
    const script = document.createElement("script");
    script.textContent = await unpack(document.getElementById("plotly").textContent);
    document.head.append(script);
    return window.Plotly;
  })();

  const colours = text => dark.matches ? Object.entries(NIGHT).reduce(
    (made, [from, to]) => made.replaceAll(from, to), text) : text;

  // Words of an axis on as many lines as they need.
  const wrapped = (text, letters) => text.split("<br>").map(line => line.split(" ").reduce(
    ([done, last], word) => last && last.length + word.length >= letters
      ? [done + last + "<br>", word] : [done, last ? `${last} ${word}` : word], ["", ""]).join("")
  ).join("<br>");

  const side = (axis, ink, grid) => Object.assign(axis, {
    gridcolor: grid, linecolor: "#98a2ab", zeroline: false, ticks: "outside", ticklen: 4,
    tickcolor: "#98a2ab", automargin: true, hoverformat: axis.type === "date" ? null : ".5~g",
    exponentformat: "none", title: Object.assign(axis.title, {standoff: 8}),
    spikemode: "across", spikethickness: 1, spikedash: "solid", spikecolor: ink,
    spikesnap: "cursor", showspikes: axis.anchor.startsWith("y")});

  const layoutOf = (spec, box) => {
    const [ink, grid, paper] = dark.matches ? ["#dfe6ec", "#303a43", "#151b21"]
      : ["#22303c", "#dfe4e8", "#ffffff"];
    const layout = spec.layout, rows = spec.rows;
    for (const [key, axis] of Object.entries(layout)) {
      if (/^[xy]axis/.test(key)) side(axis, ink, grid);
      if (/^legend/.test(key)) Object.assign(axis, {
        orientation: "h", traceorder: "normal", tracegroupgap: 0, x: 0, xanchor: "left", yanchor: "bottom", bgcolor: "rgba(0,0,0,0)",
        font: {size: 12.5}});
    }
    layout.xaxis.title.text = wrapped(layout.xaxis.title.text, box.clientWidth / (rows ? 17 : 10));
    for (const shape of layout.shapes) if (shape.showlegend) shape.legendgroup = shape.name;
    const narrow = box.clientWidth < 520;
    if (narrow && box.closest(".hero"))  // a low picture: the lines' own words would hide it
      for (const one of layout.annotations) one.font.size = 9.5;
    return Object.assign(layout, {
      font: {family: getComputedStyle(document.body).fontFamily, size: 12.5, color: ink},
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", autosize: true,
      margin: {l: narrow ? 48 : 62, r: 14, t: 26, b: 44},
      hovermode: rows ? "closest" : "x unified", hoversubplots: "axis", hoverdistance: 40,
      modebar: {bgcolor: "rgba(0,0,0,0)", color: "#98a2ab", activecolor: ink},
      hoverlabel: {bgcolor: paper, bordercolor: grid, font: {size: 12, color: ink},
        namelength: 34},
      // A finger that drags scrolls the page; the buttons above the chart zoom.
      dragmode: finger ? false : "zoom"});
  };

  const CONFIG = {responsive: true, displaylogo: false, doubleClick: "reset", scrollZoom: false,
    modeBarButtons: [["zoom2d", "pan2d"], ["zoomIn2d", "zoomOut2d", "resetScale2d"], ["toImage"]],
    displayModeBar: finger ? true : "hover", toImageButtonOptions: {scale: 2}};

  const near = box => {
    const place = box.getBoundingClientRect();
    return place.bottom > 0 && place.top < innerHeight;
  };

  const rangeOf = plot => plot.layout.xaxis.range.map(Number);

  // As if the mouse stood there; the last argument keeps it from counting as a movement.
  const hover = (plot, share) => {
    const target = plot.querySelector(".nsewdrag"), box = target.getBoundingClientRect();
    Plotly.Fx.hover(plot, {target, clientX: box.left + share * box.width,
      clientY: box.top + 0.5 * box.height}, target.dataset.subplot, true);
  };

  // The same moment in every chart on the screen.
  const point = (from, moment) => {
    if (busy) return;
    cancelAnimationFrame(pending);
    pending = requestAnimationFrame(() => {
      busy = true;
      try {
        for (const [box, one] of charts) {
          if (box === from || !one.plot || !one.clock || !near(box)) continue;
          const [low, high] = rangeOf(one.plot), at = moment * one.clock;
          const inside = moment !== null && at >= low && at <= high;
          if (inside) hover(one.plot, (at - low) / (high - low));
          else Plotly.Fx.unhover(one.plot);
        }
      } finally { busy = false; }
    });
  };

  // The same stretch of time in every chart that began with the same one.
  const stretch = (from, range) => {
    for (const [box, one] of charts) {
      if (box === from || !one.stretch || one.stretch !== charts.get(from).stretch) continue;
      one.range = range;
      if (one.plot) follow(one);
    }
  };

  const follow = one => {
    const wanted = one.range.map(second => second * one.clock), now = rangeOf(one.plot);
    const off = Math.max(...wanted.map((end, i) => Math.abs(end - now[i])));
    if (off > 1e-6 * Math.abs(wanted[1] - wanted[0]))
      Plotly.relayout(one.plot, {"xaxis.range": wanted});
  };

  const draw = async box => {
    const one = charts.get(box);
    if (one.started) return one.started;
    return one.started = (async () => {
      const Plotly = await load();
      const spec = JSON.parse(colours(box.querySelector("script").textContent));
      const plot = document.createElement("div"), picture = box.querySelector("img");
      plot.className = "plot";
      plot.style.height = `${picture.getAttribute("height")}px`;
      plot.setAttribute("role", "img");
      plot.setAttribute("aria-label", picture.alt);
      box.append(plot);
      box.classList.add("live");
      one.clock = spec.clock;
      const layout = layoutOf(spec, box);
      await Plotly.newPlot(plot, spec.data, layout, CONFIG);
      one.plot = plot;
      if (one.range) follow(one);
      else one.range = one.clock ? rangeOf(plot).map(end => end / one.clock) : null;
      if (!one.clock) return;
      plot.on("plotly_hover", event => point(box, event.points[0].x / one.clock));
      plot.on("plotly_unhover", () => point(box, null));
      plot.on("plotly_relayout", () => {
        const range = rangeOf(plot).map(end => end / one.clock);
        const moved = Math.max(...range.map((end, i) => Math.abs(end - one.range[i])));
        if (moved <= 1e-6 * Math.abs(range[1] - range[0])) return;
        one.range = range;
        stretch(box, range);
      });
    })();
  };

  const again = () => {
    for (const [box, one] of charts) {
      if (!one.plot) continue;
      window.Plotly.purge(one.plot);
      one.plot.remove();
      one.plot = one.started = null;
      box.classList.remove("live");
      draw(box);
    }
  };

  const start = () => {
    if (typeof DecompressionStream === "undefined") return;  // the pictures do
    const watch = new IntersectionObserver(found => {
      for (const one of found) if (one.isIntersecting) {
        watch.unobserve(one.target);
        draw(one.target).catch(problem => {
          one.target.classList.remove("live");
          console.error(problem);
        });
      }
    }, {rootMargin: "500px"});
    for (const box of document.querySelectorAll(".chart")) {
      charts.set(box, {stretch: box.dataset.stretch || null});
      watch.observe(box);
    }
    dark.addEventListener("change", again);
  };

  // For tests and for whoever prints the charts: draws all at once.
  window.allCharts = () => Promise.all([...charts.keys()].map(draw));
  start();
})();
