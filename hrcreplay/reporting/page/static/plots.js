// The plots below the scene: one time axis, the instant of the scene as a line; a press anywhere goes there.

const PLOTS = [
  { title: "Speed of the TCP [m/s]", series: [["ref_speed", "programmed", "programmed"], ["tcp_speed", "driven", "driven"]] },
  { title: "Distance from the robot's surface [m]", series: [["distance_m", "to all the person can reach", "volume"], ["body_m", "to the recorded body", "toBody"]], most: 2 },
];

const WINDOW_S = 120; // of a longer log the plots show the part with the instant

export class Plots {
  constructor(root, data, seek) {
    Object.assign(this, { root, data, seek, plots: [] });
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
        cursor: { drag: { x: false, y: false }, points: { show: false }, y: false },
        scales: { x: { time: false }, y: { range: (_, low, high) => [Math.min(0, low ?? 0), Math.min(most ?? Infinity, (high ?? 1) * 1.05) || 1] } },
        axes: [{ ...axis, values: (_, ticks) => ticks.map((t) => `${t} s`) }, { ...axis, size: 44 }],
        series: [{}, ...kept.map(([[, label, colour]]) => ({ label, stroke: colours[colour], width: 1.4, spanGaps: false }))],
        hooks: { drawClear: [(u) => shade(u, events, colours)], draw: [() => this.place()] },
      }, [this.seconds, ...kept.map(([, values]) => Array.from(values, (x) => (Number.isNaN(x) ? null : x)))], holder);
      const now = document.createElement("div");
      now.className = "plot-now";
      plot.over.append(now);
      this.scrubs(plot);
      return { plot, now };
    });
    this.mark(this.t_s ?? 0);
  }

  scrubs(plot) {
    const go = (event) => this.seek(plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x"));
    plot.over.addEventListener("pointerdown", (event) => {
      plot.over.setPointerCapture(event.pointerId);
      go(event);
    });
    plot.over.addEventListener("pointermove", (event) => event.buttons && go(event));
  }

  size() {
    return { width: Math.max(260, this.root.clientWidth), height: 170 };
  }

  resize() {
    this.part = null; // setSize shows all of it again
    this.plots.forEach(({ plot }) => plot.setSize(this.size()));
    this.mark(this.t_s ?? 0);
  }

  mark(t_s) {
    this.t_s = t_s;
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
