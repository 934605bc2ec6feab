// The replay: one instant, one method, and everything that shows or changes them.
import { lastNotAfter, load, nearest } from "replay/data";
import { Plots } from "replay/plots";
import { ReplayView } from "replay/scene";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10];
const COLOURS = ["stage", "grid", "gridMain", "robot", "stop", "person", "volume", "base", "bones", "programmed", "driven", "stopPath", "toBody", "toVolume", "soft", "line", "braking", "touch"];
const WIDE_PX = 720; // from this width of the stage on, two methods stand side by side when the page opens

export async function start(root) {
  const data = await load(root);
  const $ = (selector) => root.querySelector(selector);
  const { header } = data;
  const end_s = header.start_s + (header.count - 1) / header.rate_hz;
  const state = { t_s: header.open_s, method: header.order[0], beside: null, playing: false, speed: 1, tour: null };
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
  const text = (method, kind) => {
    const index = nearest(data.motion(`${method}/${kind}`), Math.floor(row() + 1e-6));
    return index >= 0 ? header.methods[method].names[kind][index] : "";
  };
  const number = (method, name) => nearest(data.motion(`${method}/${name}`), Math.floor(row() + 1e-6));
  // As the tables of the page: millimetres, milliseconds below a second, else tenths.
  const metresPerSecond = (x, programmed) =>
    Number.isFinite(x) ? `${x.toFixed(3)}${Number.isFinite(programmed) ? ` of ${programmed.toFixed(3)}` : ""} m/s` : "not known";
  const metres = (x) => (Number.isFinite(x) ? `${x.toFixed(3)} m`.replace("-", "\u2212") : "not known");
  const duration = (x) => (x < 1 ? `${Math.round(1000 * x)} ms` : `${x.toFixed(1)} s`);
  const shown = () => (state.beside === null ? [state.method] : [state.method, state.beside]);
  const title = (method) => (method === header.order[0] ? `${method} (this plan)` : method);
  view.told = label;

  function draw() {
    const near = view.draw(shown(), row(), state.t_s);
    $(".scrub").value = state.t_s;
    $(".scrub").setAttribute("aria-valuetext", `${state.t_s.toFixed(2)} seconds`);
    $(".clock").textContent = `${state.t_s.toFixed(2)} s`;
    plots.mark(state.t_s);
    tell(".readout", state.method, near[0]);
    $(".readout.other").hidden = state.beside === null;
    if (state.beside !== null) tell(".readout.other", state.beside, near[1]);
    const current = lastNotAfter(events().map((event) => event.at_s), state.t_s + 1e-3);
    if (current === state.current) return;
    state.current = current;
    const list = $(".stops ol");
    [...list.children].forEach((item, k) => item.classList.toggle("now", k === current));
    const now = list.children[current];
    if (now) list.scrollTop = now.offsetTop - list.offsetTop - list.clientHeight / 3; // the list alone, not the page
  }

  // The names of the methods, and what touches, over each picture.
  function label(near) {
    const wide = 100 / near.length;
    root.querySelectorAll(".picture").forEach((picture, k) => {
      picture.hidden = k >= near.length;
      if (picture.hidden) return;
      Object.assign(picture.style, { left: `${k * wide}%`, width: `${wide}%` });
      picture.querySelector(".picture-title").textContent = title(shown()[k]);
      const touch = picture.querySelector(".picture-touch"), touching = near[k].touching.length > 0;
      touch.hidden = !touching;
      if (!touching) return;
      touch.textContent = `contact: ${near[k].body.link} – ${near[k].body.limb}`;
      const { x, y } = view.onScreen(near[k].body.from);
      const share = Math.max(0.01, Math.min(0.99, x)); // of the picture, and of the words: they stay inside
      Object.assign(touch.style, { left: `${100 * share}%`, transform: `translateX(${-100 * share}%)`, top: `${100 * Math.max(0.1, Math.min(0.85, y + 0.07))}%` });
    });
  }

  function tell(where, method, near) {
    const status = text(method, "status"), reason = text(method, "reason");
    const body_m = number(method, "body_m");
    const lines = [
      ["method", title(method)],
      ["status", status + (reason && status !== "tracking" ? ` (${reason})` : "")],
      ["speed", metresPerSecond(number(method, "tcp_speed"), number(method, "ref_speed"))],
      [near.touching.length ? "in contact" : "to the body", near.body ? `${metres(body_m)}: ${near.body.link} – ${near.body.limb}` : "not known"],
      ["to the volumes", metres(number(method, "distance_m"))],
      ["predicted for", Number.isFinite(number(method, "horizon_s")) ? duration(number(method, "horizon_s")) : "–"],
    ];
    const certified = number(method, "certified");
    if (certified >= 0) lines.push(["stop", certified ? "certified" : "not certified"]);
    $(where).classList.toggle("in-touch", near.touching.length > 0);
    $(where).replaceChildren(...lines.flatMap(([name, value]) => {
      const dt = document.createElement("dt"), dd = document.createElement("dd");
      dt.textContent = name;
      dd.textContent = value;
      return [dt, dd];
    }));
    $(where).dataset.status = status;
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
    if (state.t_s >= end_s && state.tour === null) return play(false);
    if (!tourGoesOn()) return;
    seek(Math.min(state.t_s + state.speed * passed_s, state.tour === null ? end_s : header.tour[state.tour].until_s));
    requestAnimationFrame(tick);
  }

  // The worst moments one after the other, at their pace, each beside the method that tells most there.
  function startTour() {
    if (!header.tour.length) return;
    play(true);
    speed(1);
    visit(0);
  }

  function visit(stop) {
    const { from_s, beside, words } = header.tour[stop];
    state.tour = stop;
    $(".caption").textContent = `${stop + 1} of ${header.tour.length}. ${words}`;
    $(".caption").hidden = false;
    if (wide()) state.beside = beside;
    choose(header.order[0]);
    seek(from_s);
  }

  // Goes to the next stop at the end of one; false at the end of the tour.
  function tourGoesOn() {
    if (state.tour === null || state.t_s < header.tour[state.tour].until_s - 1e-6) return true;
    if (state.tour + 1 < header.tour.length) {
      visit(state.tour + 1);
      return true;
    }
    play(false);
    return false;
  }

  function endTour() {
    state.tour = null;
    $(".caption").hidden = true;
  }

  function play(on) {
    if (!on || state.tour !== null) endTour();
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
    const again = method === state.listed;
    state.method = state.listed = method;
    $(".method").value = method;
    $(".beside").value = state.beside ?? "";
    if (!again) {
      listStops();
      plots.show(method, colours(), events());
    }
    $(".volumes-note").hidden = shown().every((name) => name === header.order[0]);
    draw();
  }

  function putBeside(method) {
    state.beside = method || null;
    choose(state.method);
  }
  const wide = () => $(".stage").clientWidth >= WIDE_PX;

  function listStops() {
    state.current = null;
    const words = (event) => {
      const pair = event.link && event.limb ? `${event.link} – ${event.limb}` : event.link || event.limb;
      if (event.kind === "touch") return `touched: ${pair}, ${duration(event.moving_s)}, up to ${event.speed_m_per_s.toFixed(3)} m/s`;
      const rest = event.rest_s > 0 ? `, then stood ${duration(event.rest_s)}` : "";
      return `braked ${duration(event.moving_s)} from ${event.speed_m_per_s.toFixed(3)} m/s${rest}: ${[event.reason, pair].filter(Boolean).join(", ")}`;
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
    b: () => putBeside([null, ...header.order][([null, ...header.order].indexOf(state.beside) + 1) % (header.order.length + 1)]),
    t: () => startTour(),
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
  $(".tour").addEventListener("click", startTour);
  $(".tour").hidden = !header.tour.length;
  $(".beside").replaceChildren(new Option("nothing", ""), ...header.order.map((name) => new Option(title(name), name)));
  $(".beside").addEventListener("change", (event) => putBeside(event.target.value));
  $(".speed").replaceChildren(...SPEEDS.map((value) => new Option(`${value}×`, value, value === 1, value === 1)));
  $(".speed").addEventListener("change", (event) => speed(Number(event.target.value)));
  $(".method").replaceChildren(...header.order.map((name) => new Option(title(name), name)));
  $(".method").addEventListener("change", (event) => choose(event.target.value));
  root.querySelectorAll("input[data-show]").forEach((box) => box.addEventListener("change", () => {
    view.shown[box.dataset.show] = box.checked;
    view.stored = null;
    draw();
  }));
  $(".plots").addEventListener("zoom", (event) => ($(".whole").hidden = event.detail === null));
  $(".whole").addEventListener("click", () => plots.zoom(null));
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
  if (wide()) state.beside = header.beside;
  view.drawn = { methods: shown(), at: row(), t_s: state.t_s };
  view.resize($(".stage").clientWidth, $(".stage").clientHeight);
  view.home();
  const { rate_hz } = data.volumes;
  $(".volumes-rate").textContent = rate_hz
    ? `The volumes are shown ${rate_hz} times a second, robot and person ${+header.rate_hz.toFixed(1)} times.`
    : "The volumes of this run do not fit on the page: occupancy.parquet holds them.";
  choose(state.method);
  root.classList.add("replay-ready");
  window.replay = { state, seek, choose, play, putBeside, startTour, view, plots, data }; // for tests, and for the curious
}
