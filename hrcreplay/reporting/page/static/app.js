// The replay: one instant, one method, and everything that shows or changes them.
import { lastNotAfter, load, nearest } from "replay/data";
import { Plots } from "replay/plots";
import { ReplayView } from "replay/scene";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10];
const COLOURS = ["stage", "grid", "gridMain", "robot", "stop", "person", "volume", "base", "bones", "programmed", "driven", "stopPath", "toBody", "toVolume", "soft", "line", "braking", "touch"];

export async function start(root) {
  const data = await load(root);
  const $ = (selector) => root.querySelector(selector);
  const { header } = data;
  const end_s = header.start_s + (header.count - 1) / header.rate_hz;
  const state = { t_s: header.start_s, method: header.order[0], playing: false, speed: 1 };
  const view = new ReplayView($("canvas"), data, colours());
  const plots = new Plots($(".plots"), data, (t_s) => seek(t_s));

  function colours() {
    const probe = document.createElement("span");
    root.append(probe);
    const found = Object.fromEntries(COLOURS.map((name) => {
      probe.style.color = `var(--scene-${name})`;
      return [name, getComputedStyle(probe).color];
    }));
    probe.remove();
    return found;
  }

  // The first row of the data is start_s.
  const row = () => (state.t_s - header.start_s) * header.rate_hz;
  const events = () => header.methods[state.method].events;
  const text = (kind) => {
    const index = nearest(data.motion(`${state.method}/${kind}`), Math.floor(row() + 1e-6));
    return index >= 0 ? header.methods[state.method].names[kind][index] : "";
  };
  const number = (name) => nearest(data.motion(`${state.method}/${name}`), Math.floor(row() + 1e-6));
  const metresPerSecond = (x, programmed) =>
    Number.isFinite(x) ? `${x.toFixed(2)}${Number.isFinite(programmed) ? ` of ${programmed.toFixed(2)}` : ""} m/s` : "not known";
  const centimetres = (x) => (Number.isFinite(x) ? `${Math.round(100 * x)} cm` : "not known");

  function draw() {
    const near = view.show(state.method, row(), state.t_s);
    view.render();
    $(".scrub").value = state.t_s;
    $(".scrub").setAttribute("aria-valuetext", `${state.t_s.toFixed(2)} seconds`);
    $(".clock").textContent = `${state.t_s.toFixed(2)} s`;
    plots.mark(state.t_s);
    tell(near);
    const current = lastNotAfter(events().map((event) => event.at_s), state.t_s + 1e-3);
    if (current === state.current) return;
    state.current = current;
    const list = $(".stops ol");
    [...list.children].forEach((item, k) => item.classList.toggle("now", k === current));
    const now = list.children[current];
    if (now) list.scrollTop = now.offsetTop - list.offsetTop - list.clientHeight / 3; // the list alone, not the page
  }

  function tell(near) {
    const status = text("status"), reason = text("reason");
    const lines = [
      ["status", status + (reason && status !== "tracking" ? ` (${reason})` : "")],
      ["speed", metresPerSecond(number("tcp_speed"), number("ref_speed"))],
      ["to the body", near.body ? `${centimetres(number("body_m"))}: ${near.body.link} – ${near.body.limb}` : "not known"],
      ["to the volumes", centimetres(number("distance_m"))],
      ["predicted for", Number.isFinite(number("horizon_s")) ? `${Math.round(1000 * number("horizon_s"))} ms` : "–"],
    ];
    const certified = number("certified");
    if (certified >= 0) lines.push(["stop", certified ? "certified" : "not certified"]);
    $(".readout").replaceChildren(...lines.flatMap(([name, value]) => {
      const dt = document.createElement("dt"), dd = document.createElement("dd");
      dt.textContent = name;
      dd.textContent = value;
      return [dt, dd];
    }));
    $(".readout").dataset.status = status;
  }

  function seek(t_s) {
    state.t_s = Math.max(header.start_s, Math.min(end_s, t_s));
    draw();
  }

  let before_ms = null;
  function tick(now_ms) {
    if (!state.playing) return;
    const passed_s = before_ms === null ? 0 : Math.min(0.25, (now_ms - before_ms) / 1000);
    before_ms = now_ms;
    if (state.t_s >= end_s) return play(false);
    seek(state.t_s + state.speed * passed_s);
    requestAnimationFrame(tick);
  }

  function play(on) {
    if (on && state.t_s >= end_s) state.t_s = header.start_s;
    state.playing = on;
    before_ms = null;
    $(".play").textContent = on ? "Pause" : "Play";
    $(".play").setAttribute("aria-pressed", String(on));
    if (on) requestAnimationFrame(tick);
  }

  function speed(value) {
    state.speed = value;
    $(".speed").value = String(value);
  }

  function step(rows) {
    play(false);
    seek(header.start_s + (Math.round(row()) + rows) / header.rate_hz);
  }

  function jump(direction) {
    const all = events().map((event) => event.at_s);
    const next = direction > 0 ? all.find((at_s) => at_s > state.t_s + 1e-3) : all.findLast((at_s) => at_s < state.t_s - 1e-3);
    if (next !== undefined) seek(next);
  }

  function choose(method) {
    state.method = method;
    $(".method").value = method;
    listStops();
    plots.show(method, colours(), events());
    $(".volumes-note").hidden = method === header.order[0];
    draw();
  }

  function listStops() {
    state.current = null;
    const words = (event) => {
      const pair = event.link && event.limb ? `${event.link} – ${event.limb}` : event.link || event.limb;
      if (event.kind === "touch") return `touched: ${pair}, ${event.moving_s.toFixed(2)} s, up to ${event.speed_m_per_s.toFixed(2)} m/s`;
      const rest = event.rest_s > 0 ? `, then stood ${event.rest_s.toFixed(1)} s` : "";
      return `braked ${event.moving_s.toFixed(2)} s from ${event.speed_m_per_s.toFixed(2)} m/s${rest}: ${[event.reason, pair].filter(Boolean).join(", ")}`;
    };
    $(".stops ol").replaceChildren(...events().map((event) => {
      const item = document.createElement("li"), button = document.createElement("button");
      button.type = "button";
      const at = document.createElement("b");
      at.textContent = `${event.at_s.toFixed(2)} s`;
      button.append(at, ` ${words(event)}`);
      button.addEventListener("click", () => {
        play(false);
        seek(event.at_s);
      });
      item.className = event.kind;
      item.append(button);
      return item;
    }));
    const stops = events().filter((event) => event.kind === "stop").length, touches = events().length - stops;
    $(".stops h3").textContent =
      `${stops || "No"} full stop${stops === 1 ? "" : "s"}${touches ? `, ${touches} contact${touches === 1 ? "" : "s"}` : ""}`;
  }

  const keys = {
    " ": () => play(!state.playing),
    ArrowLeft: (event) => step(event.shiftKey ? -header.rate_hz : -1),
    ArrowRight: (event) => step(event.shiftKey ? header.rate_hz : 1),
    ArrowUp: () => speed(SPEEDS[Math.min(SPEEDS.length - 1, SPEEDS.indexOf(state.speed) + 1)]),
    ArrowDown: () => speed(SPEEDS[Math.max(0, SPEEDS.indexOf(state.speed) - 1)]),
    Home: () => seek(header.start_s),
    End: () => seek(end_s),
    n: () => jump(1),
    p: () => jump(-1),
    m: () => choose(header.order[(header.order.indexOf(state.method) + 1) % header.order.length]),
  };
  // The keys are the replay's while it is on the screen and nothing else on the page wants them.
  function key(event) {
    const action = keys[event.key];
    const mine = root.contains(document.activeElement) || document.activeElement === document.body;
    if (!action || !mine || !onScreen() || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.matches("select, input[type=checkbox], summary, a") || (event.key === " " && event.target.matches("button"))) return;
    event.preventDefault();
    action(event);
  }
  function onScreen() {
    const box = $("canvas").getBoundingClientRect();
    return Math.min(box.bottom, innerHeight) - Math.max(box.top, 0) > 0.4 * Math.min(box.height, innerHeight);
  }

  $(".scrub").min = header.start_s;
  $(".scrub").max = end_s;
  $(".scrub").step = 1 / header.rate_hz;
  $(".scrub").addEventListener("input", (event) => seek(Number(event.target.value)));
  $(".play").addEventListener("click", () => play(!state.playing));
  $(".back").addEventListener("click", () => jump(-1));
  $(".next").addEventListener("click", () => jump(1));
  $(".home").addEventListener("click", () => {
    view.home();
    view.render();
  });
  $(".speed").replaceChildren(...SPEEDS.map((value) => new Option(`${value}×`, value, value === 1, value === 1)));
  $(".speed").addEventListener("change", (event) => speed(Number(event.target.value)));
  $(".method").replaceChildren(...header.order.map((name, k) => new Option(k ? name : `${name} (this plan)`, name)));
  $(".method").addEventListener("change", (event) => choose(event.target.value));
  root.querySelectorAll("input[data-show]").forEach((box) => box.addEventListener("change", () => {
    view.shown[box.dataset.show] = box.checked;
    view.stored = null;
    draw();
  }));
  addEventListener("keydown", key);
  document.documentElement.addEventListener("themechange", () => {
    view.paint(colours());
    plots.show(state.method, colours(), events());
    draw();
  });
  new ResizeObserver(() => {
    const { clientWidth, clientHeight } = $(".stage");
    view.resize(clientWidth, clientHeight);
    plots.resize();
  }).observe($(".stage"));
  view.resize($(".stage").clientWidth, $(".stage").clientHeight);
  view.home();
  const { rate_hz } = data.volumes;
  $(".volumes-rate").textContent = rate_hz
    ? `The volumes are shown ${rate_hz} times a second, robot and person ${header.rate_hz} times.`
    : "The volumes of this run do not fit on the page: occupancy.parquet holds them.";
  choose(state.method);
  root.classList.add("replay-ready");
  window.replay = { state, seek, choose, play, view, data }; // for tests, and for the curious
}
