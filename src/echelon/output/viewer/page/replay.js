// The replay page: play, pause and scrub, with charts whose cursors follow.

class Player {
  constructor(run) {
    this.run = run;
    this.frame = 0;
    this.speed = 1;
    this.playing = false;
    document.body.classList.toggle("flat", run.space.kind !== "space");
    showHeader(run);
    this.view = new View($("#scene"), run);
    this.makeCharts(run.growing ? run.charts : readCharts(run));
    this.views = new ViewControls(this.view, () => this.charts, () => this.seek(this.frame));
    this.makeFooter();
    this.listen();
    this.seek(0);
  }

  makeCharts(charts) {
    this.charts = charts.map((chart) => new Chart($("#side"), chart, (time) => this.seek(this.run.frameOf(time))));
  }

  // Takes more frames of a run that is being computed.
  grow(newest) {
    const { run } = this;
    if (!this.charts.length) this.makeCharts(run.charts);
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
    sessionStorage.setItem("echelon", JSON.stringify([this.run.title, this.run.at(this.frame).time]));
    location.reload();
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
    $("footer").append(this.button, this.clock, this.scrub, speed, this.views.box);
  }

  listen() {
    const keys = {
      " ": () => this.play(!this.playing),
      ArrowRight: (fast) => this.step(fast ? 1 : 0.1),
      ArrowLeft: (fast) => this.step(fast ? -1 : -0.1),
      Home: () => this.seek(0),
      End: () => this.seek(this.run.frames - 1),
      h: () => this.views.home(),
    };
    addEventListener("keydown", (event) => {
      if (!keys[event.key] || event.target.matches("select, input") || event.ctrlKey || event.metaKey) return;
      if (event.key === " " && event.target.matches("button")) return;
      event.preventDefault();
      keys[event.key](event.shiftKey);
    });
  }

  step(seconds) {
    this.play(false);
    this.seek(this.run.frameOf(this.run.at(this.frame).time + seconds));
  }

  seek(frame) {
    const { run } = this;
    this.frame = Math.max(0, Math.min(run.frames - 1, frame));
    const moment = run.at(this.frame);
    this.view.show(moment);
    this.views.update(moment);
    this.scrub.value = this.frame;
    this.clock.innerHTML = `<b>${moment.time.toFixed(2)}</b> / ${run.clock.last.toFixed(run.clock.last < 100 ? 1 : 0)} s`;
    for (const chart of this.charts) chart.point(moment.time);
  }

  play(on) {
    if (on === this.playing) return;
    if (on && this.frame >= this.run.frames - 1) this.seek(0);
    this.playing = on;
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
  return run.charts.map((chart) => ({
    ...chart,
    times: run.chartTimes,
    lines: chart.lines.map((line) => ({ ...line, values: line.ends ? run.chartTimes.map((t) => line.ends[0] + line.ends[1] * t) : curve(line.series) })),
  }));
}

export async function start(data) {
  const length = new DataView(data).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  if (header.stream) return startLive(header);
  const run = header.growing ? new Growing(header) : new Replay(header, new Uint8Array(data, 4 + length));
  const player = new Player(run);
  if (header.growing) player.showNote("Computing the first part."), loadParts(run, player);
  else restoreTime(player);
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

// Continues at the time before the page was reloaded.
function restoreTime(player) {
  let before = null;
  try {
    before = JSON.parse(sessionStorage.getItem("echelon"));
    sessionStorage.removeItem("echelon");
  } catch {
    // A local file may have no storage.
  }
  if (before && before[0] === player.run.title) player.seek(player.run.frameOf(before[1]));
}
