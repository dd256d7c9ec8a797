// The replay page: play, pause and scrub one run, or two at the same time, with charts whose cursors follow.

// A run in its part of the page: the scene, and the charts.
class Pane {
  constructor(run, part, title, window, seek) {
    Object.assign(this, { run, part, window, seek, charts: [] });
    showHeader(run, part, title);
    this.view = new View(part.querySelector(".scene"), run);
    this.closest = part.querySelector(".closest");
    this.makeCharts(run.growing ? run.charts : readCharts(run));
  }

  makeCharts(charts) {
    this.charts = charts.map((chart) => new Chart(this.part.querySelector(".side"), chart, this.window, this.seek));
    this.extend();
  }

  extend() {
    if (this.charts.length) this.window.extend(this.charts[0].times);
  }

  show(frame) {
    const { run } = this, moment = run.at(frame);
    this.view.show(moment);
    const last = (rows) => rows[upper(rows.map(([time]) => time), moment.time) - 1];
    showClosest(this.closest, last(run.closest), run);
    showMoment(this.part, last(run.moments));
    for (const chart of this.charts) chart.point(moment.time);
    return moment;
  }
}

class Player {
  // The first run sets the title; the one that ends last sets the frames.
  constructor(runs) {
    Object.assign(this, { frame: 0, speed: 1, playing: false });
    document.body.classList.toggle("flat", runs[0].space.kind !== "space");
    this.window = new TimeWindow(() => this.charts.forEach((chart) => chart.draw()));
    const parts = makeParts(runs);
    if (runs.length > 1 && runs[0].space.kind === runs[1].space.kind) joinBoxes(runs);
    this.panes = runs.map((run, k) => new Pane(run, ...parts[k], this.window, (time) => this.seekTime(time)));
    for (const chart of this.charts) chart.twin = this.charts.find((other) => other !== chart && other.title === chart.title && other.unit === chart.unit);
    this.leading = this.panes.reduce((a, b) => (b.run.clock.last > a.run.clock.last ? b : a));
    this.run = this.leading.run;
    this.view = this.panes[0].view;
    this.views = new ViewControls(this.panes.map((pane) => pane.view), () => this.charts, () => this.seek(this.frame));
    this.makeFooter();
    this.listen();
    this.seek(0);
    addEventListener("hashchange", () => this.seekLink());
    this.seekLink();
  }

  get charts() {
    return this.panes.flatMap((pane) => pane.charts);
  }

  // Takes more frames of a run that is being computed.
  grow(newest) {
    const { run, leading } = this;
    if (!this.charts.length) leading.makeCharts(run.charts);
    leading.extend();
    if (run.path) this.view.path?.place(run.path);
    this.scrub.max = run.frames - 1;
    this.showNote(`Computed until ${run.reached.toFixed(1)} of ${run.horizon} s.`);
    this.seek(newest ? run.frames - 1 : this.frame);
    for (const chart of this.charts) chart.draw();
  }

  showNote(words) {
    $(".notes").textContent = words;
  }

  // Loads the complete run instead of its parts, at the same time.
  reload() {
    this.link();
    location.reload();
  }

  // Puts the time into the address, which is then a link to it.
  link() {
    try {
      history.replaceState(null, "", `#t=${Number(this.run.at(this.frame).time.toFixed(3))}`);
    } catch {
      // A page inside of another one may have no address.
    }
  }

  seekLink() {
    const time = Number(new URLSearchParams(location.hash.slice(1)).get("t") ?? NaN);
    if (Number.isFinite(time)) this.seekTime(time);
  }

  seekTime(time) {
    this.seek(this.run.frameOf(time));
  }

  makeFooter() {
    const { run } = this, last = run.frames - 1;
    this.button = make("button", { id: "play", title: "play or pause (space)", "aria-label": "play or pause" }, icon("play"));
    this.scrub = make("input", { id: "scrub", type: "range", min: 0, max: last, step: "any", value: 0, "aria-label": "time" });
    this.clock = make("span", { class: "time" });
    const speed = make("select", { title: "speed", "aria-label": "speed" });
    for (const value of [0.1, 0.25, 0.5, 1, 2, 5, 10]) speed.append(make("option", { value, ...(value === 1 ? { selected: "" } : {}) }, `${value} \u00d7`));
    this.button.addEventListener("click", () => this.play(!this.playing));
    this.scrub.addEventListener("input", () => (this.play(false), this.seek(Number(this.scrub.value))));
    speed.addEventListener("change", () => (this.speed = Number(speed.value)));
    const marks = run.moments.map(([time, words]) => make("i", { class: "mark", title: words, style: `left: calc(8px + ${run.frameOf(time) / last} * (100% - 16px))` }));
    $("footer").append(this.button, this.clock, make("span", { class: "track" }, this.scrub, ...marks), speed, this.views.box);
  }

  listen() {
    listenKeys({
      " ": ["play, pause", () => this.play(!this.playing)],
      ArrowRight: ["0.1 s ahead, with shift 1 s", (fast) => this.step(fast ? 1 : 0.1)],
      ArrowLeft: ["0.1 s back, with shift 1 s", (fast) => this.step(fast ? -1 : -0.1)],
      Home: ["first frame", () => this.seek(0)],
      End: ["last frame", () => this.seek(this.run.frames - 1)],
      ...this.views.keys,
    });
  }

  step(seconds) {
    this.play(false);
    this.seek(this.run.frameOf(this.run.at(this.frame).time + seconds));
  }

  seek(frame) {
    const { run, leading } = this;
    this.frame = Math.max(0, Math.min(run.frames - 1, frame));
    const { time } = leading.show(this.frame);
    for (const pane of this.panes) {
      if (pane !== leading) pane.show(pane.run.frameOf(time));
      this.views.update(pane.view, pane.run.moment);
    }
    this.scrub.value = this.frame;
    this.clock.innerHTML = `<b>${time.toFixed(2)}</b> / ${run.clock.last.toFixed(run.clock.last < 100 ? 1 : 0)} s`;
    clearTimeout(this.rest);
    if (!this.playing && time > 0) this.rest = setTimeout(() => this.link(), 400);
  }

  play(on) {
    if (on === this.playing) return;
    if (on && this.frame >= this.run.frames - 1) this.seek(0);
    this.playing = on;
    if (!on) this.link();
    this.button.replaceChildren(icon(on ? "pause" : "play"));
    if (on) requestAnimationFrame((now) => this.tick(now, now));
  }

  // Advances by the clock, at any frame rate.
  tick(now, before) {
    if (!this.playing) return;
    const { run } = this, time = run.at(this.frame).time + (this.speed * Math.min(250, now - before)) / 1000;
    this.seek(run.frameOf(time));
    if (this.frame >= run.frames - 1) this.play(false);
    else requestAnimationFrame((later) => this.tick(later, now));
  }
}

// Charts with their curves.
function readCharts(run) {
  if (!run.series) return [];
  const curve = (c) => Array.from({ length: run.series.frames }, (_, k) => valueOf(run.series, c, k, 0));
  return run.charts.map((chart, place) => ({
    ...chart,
    moments: place ? run.moments.map(([time]) => [time, ""]) : run.moments,
    times: run.chartTimes,
    lines: chart.lines.map((line) => ({ ...line, values: line.ends ? run.chartTimes.map((t) => line.ends[0] + line.ends[1] * t) : curve(line.series) })),
  }));
}

// The part of the page and the title of each run; a second run has a copy of both beside the first.
function makeParts(runs) {
  const part = $("main"), title = $(".title");
  if (runs.length === 1) return [[part, title]];
  const parts = runs.map((_, k) => (k ? part.cloneNode(true) : part)), titles = runs.map(() => title.cloneNode(true));
  parts.forEach((each, k) => {
    each.prepend(titles[k]);
    if (k) (each.querySelectorAll("[id]").forEach((element) => element.removeAttribute("id")), part.after(each));
  });
  title.replaceChildren(make("h1", {}, runs.map((run) => run.title).join(" and ")));
  document.body.classList.add("beside");
  return parts.map((each, k) => [each, titles[k]]);
}

// Gives two runs the box around both, so that their cameras begin alike.
function joinBoxes([one, other]) {
  const join = (end, choose) => one.box[end].map((value, k) => choose(value, other.box[end][k]));
  one.box = other.box = { low: join("low", Math.min), high: join("high", Math.max) };
}

function readRun(data) {
  const length = new DataView(data).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  return header.stream ? header : header.growing ? new Growing(header) : new Replay(header, new Uint8Array(data, 4 + length));
}

export async function start(...data) {
  const runs = data.map(readRun), [run] = runs;
  if (run.stream) return startLive(run);
  const player = new Player(runs);
  if (run.growing) player.showNote("Computing the first part."), loadParts(run, player);
  // For the tests of the page.
  globalThis.echelon = {
    run, player,
    seek: (frame) => player.seek(frame),
    play: (on) => player.play(on),
    get frame() { return player.frame; },
    get last() { return run.frames - 1; },
    position: (agent) => [...run.moment.position.subarray(3 * agent, 3 * agent + 3)],
    turn: (agent) => [...run.moment.turn.subarray(4 * agent, 4 * agent + 4)],
    goal: (agent) => [...run.moment.goal.subarray(3 * agent, 3 * agent + 3)],
    get links() { return run.edges.filter((_, k) => player.view.alive[k]); },
    whereOnScreen: (agent) => player.view.projectAgent(agent),
  };
}
