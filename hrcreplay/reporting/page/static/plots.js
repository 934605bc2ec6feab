// The plots below the scene: one time axis, the instant of the scene as a line. A press goes there, a drag shows the
// dragged stretch alone, and a double click all of it again.

const PLOTS = [
  { title: "Speed of the TCP [m/s]", series: [["ref_speed", "programmed", "programmed"], ["tcp_speed", "driven", "driven"]] },
  { title: "Distance from the robot's surface [m]", series: [["distance_m", "to all the person can reach", "volume"], ["body_m", "to the recorded body", "toBody"]], most: 2 },
];

const DRAG_PX = 5; // a shorter one is a press
const WINDOW_S = 120; // of a longer log the plots show the part with the instant

export class Plots {
  constructor(root, data, seek) {
    Object.assign(this, { root, data, seek, plots: [], zoomed: null });
    const { rate_hz, start_s, count } = data.header;
    this.seconds = Float64Array.from({ length: count }, (_, k) => start_s + k / rate_hz);
  }

  // Draws the plots of a method anew; colours by name.
  show(method, colours, events) {
    this.plots.forEach(({ plot }) => plot.destroy());
    this.root.textContent = "";
    this.part = null;
    this.plots = PLOTS.map(({ title, series, most }) => {
      const columns = series.map(([name]) => this.data.motion(`${method}/${name}`).values);
      const kept = series.map((one, k) => [one, columns[k]]).filter(([, values]) => values.some(Number.isFinite));
      const holder = document.createElement("div");
      holder.className = "plot";
      this.root.append(holder);
      const axis = { stroke: colours.soft, grid: { stroke: colours.line, width: 1 }, ticks: { stroke: colours.line, width: 1 }, font: "12px system-ui, sans-serif" };
      const plot = new uPlot({
        title,
        ...this.size(),
        legend: { live: false },
        cursor: { drag: { x: true, y: false, setScale: false, dist: DRAG_PX }, points: { show: false }, y: false, bind: { dblclick: () => () => this.zoom(null) } },
        scales: { x: { time: false }, y: { range: (_, low, high) => [Math.min(0, low ?? 0), Math.min(most ?? Infinity, (high ?? 1) * 1.05) || 1] } },
        axes: [{ ...axis, values: (_, ticks) => ticks.map((t) => `${t} s`) }, { ...axis, size: 44 }],
        series: [{}, ...kept.map(([[, label, colour]]) => ({ label, stroke: colours[colour], width: 1.4, spanGaps: false }))],
        hooks: { drawClear: [(u) => shade(u, events, colours)], draw: [() => this.place()], setSelect: [(u) => this.select(u)] },
      }, [this.seconds, ...kept.map(([, values]) => Array.from(values, (x) => (Number.isNaN(x) ? null : x)))], holder);
      const now = document.createElement("div");
      now.className = "plot-now";
      plot.over.append(now);
      this.scrubs(plot);
      return { plot, now };
    });
    this.zoom(this.zoomed);
    this.mark(this.t_s ?? 0);
  }

  // A press without a drag goes to its instant.
  scrubs(plot) {
    let from_px = null;
    plot.over.addEventListener("pointerdown", (event) => {
      plot.syncRect(); // the page may have moved since the plot was drawn
      from_px = event.clientX;
    });
    plot.over.addEventListener("pointerup", (event) => {
      if (from_px === null || Math.abs(event.clientX - from_px) >= DRAG_PX) return;
      this.seek(plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x"));
    });
  }

  select(plot) {
    const { left, width } = plot.select;
    if (width < DRAG_PX) return;
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.zoom([plot.posToVal(left, "x"), plot.posToVal(left + width, "x")]);
  }

  // Shows a stretch [s, s] alone; null: all, or of a long log the part with the instant.
  zoom(stretch) {
    this.zoomed = stretch;
    this.part = null;
    const [min, max] = stretch ?? [this.seconds[0], this.seconds[this.seconds.length - 1]];
    for (const { plot } of this.plots) plot.setScale("x", { min, max });
    if (stretch === null) this.mark(this.t_s ?? 0);
    this.root.dispatchEvent(new CustomEvent("zoom", { detail: stretch }));
  }

  size() {
    return { width: Math.max(260, this.root.clientWidth), height: 170 };
  }

  resize() {
    this.part = null; // setSize shows all of it again
    this.plots.forEach(({ plot }) => plot.setSize(this.size()));
    this.zoom(this.zoomed);
    this.mark(this.t_s ?? 0);
  }

  mark(t_s) {
    this.t_s = t_s;
    if (this.zoomed !== null) return this.place();
    const first = this.seconds[0], last = this.seconds[this.seconds.length - 1];
    const part = Math.floor((t_s - first) / WINDOW_S);
    if (last - first > WINDOW_S && part !== this.part) {
      this.part = part;
      const min = Math.min(first + part * WINDOW_S, last - WINDOW_S);
      for (const { plot } of this.plots) plot.setScale("x", { min, max: min + WINDOW_S });
    }
    this.place();
  }

  place() {
    for (const { plot, now } of this.plots) now.style.transform = `translateX(${plot.valToPos(this.t_s, "x")}px)`;
  }
}

// Stops and touches as bands behind the lines.
function shade(u, events, colours) {
  const { ctx, bbox } = u;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  for (const { kind, at_s, moving_s } of events) {
    const from = u.valToPos(at_s, "x", true), to = u.valToPos(at_s + moving_s, "x", true);
    ctx.fillStyle = kind === "touch" ? colours.touch : colours.braking;
    ctx.globalAlpha = 0.3;
    ctx.fillRect(from, bbox.top, Math.max(to - from, devicePixelRatio), bbox.height);
  }
  ctx.restore();
}
