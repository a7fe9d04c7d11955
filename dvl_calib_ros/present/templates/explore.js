"use strict";
// Figures over time become charts: a cursor and a zoom that all charts of one run share. What the chart shows is the
// data of the picture; the picture stays for print and wherever this script does not run.
(async () => {
  const HEIGHT = 250, SOFT = "#5b6670", GRID = "#e3e7ea";
  const runs = new Map(), maps = new Map();  // charts and maps by run
  let moving = false, zoomed = null;

  async function unpacked(text) {
    const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return JSON.parse(await new Response(stream).text());
  }

  function shown(value) {
    return value == null ? "–" : Math.abs(value) >= 1e4 ? value.toPrecision(3) : String(+value.toPrecision(4));
  }

  function together(chart, action) {
    if (moving) return;
    moving = true;
    for (const other of runs.get(chart.run)) if (other !== chart) action(other);
    moving = false;
  }

  // the limits of the picture while the whole run is shown, those of what is visible when zoomed
  function yRange(plot) {
    return (chart, low, high) => {
      const x = chart.scales.x;
      const whole = x.min == null || x.max - x.min > 0.999 * (plot.x_limits[1] - plot.x_limits[0]);
      if (whole || low == null || !(high > low)) return plot.y_limits;
      if (plot.log) return [low / 1.2, high * 1.2];
      const margin = 0.08 * (high - low);
      return [low - margin, high + margin];
    };
  }

  function background(plot) {
    return chart => {
      const { ctx, bbox } = chart;
      ctx.save();
      ctx.beginPath();
      ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
      ctx.clip();
      ctx.fillStyle = "#eceff1";
      for (const [from, to] of plot.breaks) {
        const left = chart.valToPos(from, "x", true);
        ctx.fillRect(left, bbox.top, chart.valToPos(to, "x", true) - left, bbox.height);
      }
      ctx.strokeStyle = "#222222";
      ctx.lineWidth = devicePixelRatio;
      for (const level of plot.levels) {
        const at = chart.valToPos(level, "y", true);
        ctx.beginPath();
        ctx.moveTo(bbox.left, at);
        ctx.lineTo(bbox.left + bbox.width, at);
        ctx.stroke();
      }
      ctx.restore();
    };
  }

  function drawn(figure, plot) {
    const image = figure.querySelector("img");
    const place = document.createElement("div");
    place.className = "chart rest";
    place.setAttribute("role", "img");
    place.setAttribute("aria-label", image.alt);
    image.after(place);
    figure.classList.add("explorable");

    const series = [{ label: plot.x_label.replace(/^time from the start/, "time"), value: (u, v) => shown(v) }];
    const tables = [], bands = [];
    for (const sleeve of plot.sleeves) {
      bands.push({ series: [series.length + 1, series.length], fill: sleeve.color });
      for (const side of ["low", "high"]) {
        series.push({ class: "quiet", stroke: "transparent", width: 0, points: { show: false }, spanGaps: true });
        tables.push([sleeve.x, sleeve[side]]);
      }
    }
    for (const line of plot.lines) {
      series.push({
        label: line.name, class: line.name ? undefined : "quiet", stroke: line.color, width: line.points ? 0 : line.width,
        dash: line.dashed ? [7, 4] : undefined, value: (u, v) => shown(v),
        paths: line.points ? () => null : undefined,
        points: { show: line.points, size: 3, width: 0, fill: line.color + "88" },
      });
      tables.push([line.x, line.y]);
    }
    const font = "11px system-ui, sans-serif", grid = { stroke: GRID, width: 1 }, ticks = { stroke: GRID, width: 1, size: 4 };
    const chart = new uPlot({
      width: place.clientWidth, height: HEIGHT, series, bands,
      scales: {
        x: { time: false, range: (u, low, high) => low == null ? plot.x_limits : [low, high] },
        y: { distr: plot.log ? 3 : 1, range: yRange(plot) },
      },
      axes: [
        { stroke: SOFT, font, labelFont: font, label: plot.x_label, labelSize: 18, size: 26, grid, ticks },
        { stroke: SOFT, font, labelFont: font, label: plot.y_label, labelSize: 18, size: 48, grid, ticks,
          values: (u, splits) => splits.map(
            v => v == null || plot.log && Math.abs(Math.log10(v) - Math.round(Math.log10(v))) > 1e-9 ? "" : shown(v)) },
      ],
      cursor: { y: false, points: { size: 6 }, drag: { x: true, y: false },
                bind: { dblclick: () => () => { whole(plot.run); return null; } } },
      hooks: {
        drawClear: [background(plot)],
        setCursor: [u => {
          const at = u.cursor.left < 0 ? null : u.posToVal(u.cursor.left, "x");
          place.classList.toggle("rest", at == null);
          for (const show of maps.get(plot.run) ?? []) show(at);
          together(u, other => other.setCursor(
            at == null ? { left: -10, top: -10 } : { left: other.valToPos(at, "x"), top: 10 }));
        }],
        setScale: [(u, key) => {
          if (key !== "x" || !runs.has(plot.run)) return;
          const { min, max } = u.scales.x;
          together(u, other => other.setScale("x", { min, max }));
          if (!moving) said(plot, min, max);
        }],
      },
    }, uPlot.join(tables), place);
    chart.run = plot.run;
    chart.limits = plot.x_limits;
    chart.setScale("x", { min: plot.x_limits[0], max: plot.x_limits[1] });
    new ResizeObserver(() => {
      if (place.clientWidth && place.clientWidth !== chart.width) chart.setSize({ width: place.clientWidth, height: HEIGHT });
    }).observe(place);
    return chart;
  }

  // a point on each track of a map, where the vehicle was at the cursor
  function mapped(figure, plot) {
    const image = figure.querySelector("img"), place = document.createElement("div");
    place.className = "map";
    image.replaceWith(place);
    place.append(image);
    const points = plot.tracks.map(track => {
      const point = document.createElement("span");
      point.style.background = track.color;
      point.hidden = true;
      place.append(point);
      return point;
    });
    // by hand as well: the charts of the run follow
    const slider = document.createElement("input");
    Object.assign(slider, { type: "range", min: 0, max: plot.times.length - 1, value: 0, className: "slider" });
    slider.setAttribute("aria-label", "time along the track");
    place.after(slider);
    slider.addEventListener("input", () => {
      const at = plot.times[+slider.value], [chart] = runs.get(plot.run) ?? [];
      if (chart) chart.setCursor({ left: chart.valToPos(at, "x"), top: 10 }); else show(at);
    });
    const show = at => {
      let low = 0, high = plot.times.length - 1;
      while (low < high) {
        const middle = (low + high) >> 1;
        if (plot.times[middle] < at) low = middle + 1; else high = middle;
      }
      points.forEach((point, i) => {
        point.hidden = at == null;
        point.style.left = `${plot.tracks[i].x[low]}%`;
        point.style.top = `${plot.tracks[i].y[low]}%`;
      });
      if (at != null) slider.value = low;
    };
    return show;
  }

  // ---------------------------------------------------------------- what is shown, and the way back
  const bar = document.createElement("div");
  bar.className = "zoom";
  bar.hidden = true;
  const text = document.createElement("span");
  bar.append(text);
  for (const [name, title, action] of [
    ["−", "show twice as much", () => scaled(2.0)], ["+", "show half as much", () => scaled(0.5)],
    ["◀", "earlier", () => scaled(1.0, -0.5)], ["▶", "later", () => scaled(1.0, 0.5)],
    ["whole run", "show all (Esc)", () => whole(zoomed.run)],
  ]) {
    const button = document.createElement("button");
    button.textContent = name;
    button.title = title;
    button.addEventListener("click", action);
    bar.append(button);
  }

  function zoom(run, min, max) {
    const [first] = runs.get(run);
    const [low, high] = first.limits, width = Math.min(max - min, high - low);
    min = Math.max(low, Math.min(min, high - width));
    first.setScale("x", { min, max: min + width });
  }
  function whole(run) { zoom(run, ...runs.get(run)[0].limits); }
  function scaled(factor, shift = 0.0) {
    const width = zoomed.max - zoomed.min, middle = zoomed.min + (0.5 + shift) * width;
    zoom(zoomed.run, middle - 0.5 * factor * width, middle + 0.5 * factor * width);
  }
  function said(plot, min, max) {
    zoomed = { run: plot.run, min, max };
    bar.hidden = max - min > 0.999 * (plot.x_limits[1] - plot.x_limits[0]);
    text.textContent = `${shown(min)} to ${shown(max)} ${plot.x_label.split(", ").pop()}`;
  }
  document.addEventListener("keydown", event => {
    if (event.key === "Escape" && zoomed && !bar.hidden) whole(zoomed.run);
  });

  document.body.append(bar);
  for (const figure of document.querySelectorAll("figure[data-plot]")) {
    try {
      const plot = await unpacked(figure.dataset.plot);
      const [kept, one] = plot.tracks ? [maps, mapped(figure, plot)] : [runs, drawn(figure, plot)];
      kept.set(plot.run, [...(kept.get(plot.run) ?? []), one]);
    } catch (error) {
      console.warn(error);  // an old browser: the picture is there
      figure.classList.remove("explorable");
      figure.querySelector(".chart")?.remove();
    }
  }
  document.documentElement.dataset.explorable = "ready";
})();
