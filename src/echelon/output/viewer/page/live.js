// The live page: the same scene and charts, fed by a stream, and the knobs.

const SHOWN_SECONDS = 30;

// Reads blocks from a stream: each has its length before it.
async function* blocksOf(response) {
  const reader = response.body.getReader();
  let rest = new Uint8Array(0);
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    const joined = new Uint8Array(rest.length + value.length);
    joined.set(rest);
    joined.set(value, rest.length);
    rest = joined;
    while (rest.length >= 4) {
      const length = new DataView(rest.buffer, rest.byteOffset).getUint32(0, true);
      if (rest.length < 4 + length) break;
      yield rest.slice(4, 4 + length);
      rest = rest.subarray(4 + length);
    }
  }
}

class Live {
  constructor(header) {
    Object.assign(this, { run: { ...header, offsets: expand(header.offsets, header.agents, header.space) }, paused: false, pictures: 0 });
    const { run } = this;
    document.body.classList.toggle("flat", run.space.kind !== "space");
    dress(run);
    this.moment = new Moment(run.agents);
    this.panel = make("div", { class: "panel" });
    $("#side").append(this.panel);
    this.view = new View($("#scene"), run);
    this.makeCharts();
    this.views = new ViewControls(this.view, () => this.charts, () => this.show());
    this.views.onlink = (edge) => this.ask(this.view.cut[edge] ? "restore" : "cut", run.edges[edge]);
    this.makeKnobs(run.knobs, run.choices);
    this.makeFooter();
    this.chosenAgent = run.agents > 1 ? [...Array(run.agents).keys()].find((i) => !run.leaders.includes(i)) : 0;
    this.listen();
  }

  // ---- what is shown ----

  makeCharts() {
    const { run } = this, line = (name, colour) => ({ name, colour, values: [] });
    const told = [{ title: "formation error", unit: run.unit, log: true, lines: [line("worst", 1), line("median", 0)], marks: [{ value: 0.01, name: run.unit ? "1 cm" : "0.01" }] }];
    if (run.limited) told.push({ title: run.loads ? "motors" : "inputs", unit: "% of the limit", log: false, lines: [line("largest", 1), line("smallest", 0)], marks: [{ value: 100, name: "limit", below: true }, { value: 0, name: "limit" }] });
    if (run.lyapunov) told.splice(1, 0, { title: "Lyapunov function V", unit: "", log: true, lines: [line("V", 0)], marks: [] });
    this.charts = told.map((each) => new Chart($("#side"), { ...each, times: [] }));
  }

  take(block) {
    const data = new DataView(block.buffer, block.byteOffset, block.length);
    if (data.getUint32(0, true) === 1) return void this.hear(JSON.parse(new TextDecoder().decode(block.subarray(4))));
    const numbers = new Float32Array(block.buffer.slice(block.byteOffset + 16, block.byteOffset + block.length));
    this.fill(data.getFloat64(8, true), numbers);
  }

  fill(time, numbers) {
    const { run, moment } = this, { agents, axes, turns, loads } = run;
    const [worst, median, most, least, lyapunov, factor, wind] = numbers;
    let at = 7;
    at = this.places(numbers, at, axes, moment.position, time);
    at = this.places(numbers, at, axes, moment.goal, time);
    for (let i = 0; i < agents; i++, at += turns)
      if (turns === 3) moment.setAngles(i, numbers[at], numbers[at + 1], numbers[at + 2]);
      else if (turns) moment.setAngles(i, 0, 0, numbers[at]);
    for (let i = 0; i < agents; i++, at += loads) for (let k = 0; k < loads; k++) moment.motors[4 * i + k] = numbers[at + k];
    if (this.pictures++ && time < moment.time) this.view.trail.forget();
    this.view.trail.push(moment.position, time);
    moment.time = time;
    this.numbers = { worst, median, lyapunov, factor, wind };
    // A logarithm has no 0, and below rounding there is nothing to see.
    const log = (value, floor = 1e-17) => (value > floor ? Math.log10(value) : NaN);
    // V is of the second order in errors.
    this.chart(time, [[log(worst), log(median)], ...(run.lyapunov ? [[log(lyapunov, 1e-34)]] : []), [100 * most, 100 * least]]);
    this.clock.innerHTML = `<b>${time.toFixed(1)}</b> s${factor < 0.95 ? ` \u00b7 ${factor.toFixed(2)} \u00d7 real time` : ""}`;
    this.show();
  }

  places(numbers, at, axes, out, time) {
    const { space, agents } = this.run, [sx, sy] = space.stretch, stretch = [sx, sy, 1];
    for (let i = 0; i < agents; i++, at += axes) {
      if (space.kind === "time") {
        out[3 * i] = sx * (time % this.run.duration);
        out[3 * i + 1] = sy * numbers[at];
      } else for (let k = 0; k < axes; k++) out[3 * i + k] = numbers[at + k] * stretch[k];
    }
    return at;
  }

  show() {
    this.view.show(this.moment);
    this.views.update(this.moment);
  }

  chart(time, rows) {
    this.charts.forEach((chart, place) => {
      if (chart.times.length && time <= chart.times[chart.times.length - 1]) (chart.times.length = 0), chart.lines.forEach((line) => (line.values.length = 0));
      chart.times.push(time);
      chart.lines.forEach((line, k) => line.values.push(rows[place][k]));
      while (chart.times[0] < time - SHOWN_SECONDS) (chart.times.shift(), chart.lines.forEach((line) => line.values.shift()));
    });
    // Curves are drawn a few times a second, which leaves the pictures to the scene.
    const now = performance.now();
    if (now - (this.charted ?? 0) < 180) return;
    this.charted = now;
    for (const chart of this.charts) (chart.draw(), chart.point(time));
  }

  hear(told) {
    if (told.promise) this.tellPromise(told.promise);
    if (told.note !== undefined) this.note = told.note;
    if (told.reset) this.view.trail.forget();
    if (told.panel) (this.makeKnobs(told.panel, told.choices), this.view.setHeard(told.heard));
    if (told.knobs) this.stand(told);
    this.tellNotes();
  }

  tellPromise(badge) {
    tellPromise(badge);
    this.promise = badge;
    this.causes = badge.causes ?? [];
    const knob = this.knobs.coupling;
    if (knob && badge.edge) knob.mark(badge.edge);
  }

  tellNotes() {
    $(".notes").replaceChildren(...[this.note, ...(this.causes ?? []).slice(0, 3)].filter(Boolean).map((words) => make("p", {}, ...prose(words))));
  }

  stand(told) {
    for (const [name, value] of Object.entries({ ...told.knobs, ...told.chosen })) this.knobs[name]?.set(value);
    const cut = new Set(told.cut.map(([i, j]) => `${i} ${j}`));
    this.run.edges.forEach(([i, j], edge) => this.view.cutLink(edge, cut.has(`${i} ${j}`)));
    this.stood = told;
    this.chosen = told.chosen;
    this.paused = told.paused;
    this.pauseButton.replaceChildren(icon(this.paused ? "play" : "pause"));
  }

  // ---- what is asked ----

  async ask(name, value) {
    try {
      const answer = await fetch("/knob", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ name, value }) });
      const told = await answer.json();
      if (told.fault) this.refuse(told.fault);
      return told;
    } catch {
      this.note = "The server has ended.";
      this.tellNotes();
      return {};
    }
  }

  // What was refused is said for a while, and knobs go back to where they stand.
  refuse(words) {
    this.note = words;
    this.tellNotes();
    setTimeout(() => this.note === words && ((this.note = ""), this.tellNotes()), 12000);
    for (const knob of Object.values(this.knobs)) knob.held = -1e9;
    if (this.stood) this.stand(this.stood);
  }

  // Knobs and choices of the law that runs.
  makeKnobs(knobs, choices) {
    this.knobs = {};
    this.panel.replaceChildren();
    for (const told of knobs) {
      const turned = (value) => this.ask(told.name, value);
      const knob = told.name === "feedforward" ? new Switch(told, turned) : new Knob(told, turned);
      this.knobs[told.name] = knob;
      this.panel.append(knob.element);
    }
    const words = { law: "law", method: "gain method", shape: "shape" };
    const rows = Object.entries(choices).filter(([, names]) => names.length > 1);
    this.panel.append(make("div", { class: "choices" }, ...rows.map(([name, names]) => this.makeChoice(name, words[name], names))));
    this.makeButtons();
  }

  makeButtons() {
    const button = (words, title, act) => {
      const made = make("button", { title }, words);
      made.addEventListener("click", act);
      return made;
    };
    this.panel.append(make("div", { class: "buttons" },
      button("kick", "push the chosen agent, or the first follower", () => this.ask("kick", this.view.selected >= 0 ? this.view.selected : this.chosenAgent)),
      button("reset", "begin again, the knobs as they are", () => this.ask("reset")),
      button("save as scenario", "a file that repeats what was done", () => this.save())));
    this.panel.append(make("p", { class: "hint" }, "click a link to cut or restore it, an agent to choose it"));
  }

  // A list to choose from, of which one stands for what the scenario says.
  makeChoice(name, words, names) {
    const select = make("select", { "aria-label": words });
    for (const each of names) select.append(make("option", { value: each }, each === "scenario" ? "the scenario's" : each));
    const set = (value) => (select.value = value ?? "scenario");
    // What is refused leaves the choice as it was.
    select.addEventListener("change", async () => {
      const told = await this.ask(name, select.value);
      if (told.fault) set(this.chosen?.[name]);
    });
    this.knobs[name] = { set };
    return make("label", { class: "choice" }, make("span", {}, words), select);
  }

  async save() {
    const { text } = await this.ask("save");
    if (!text) return;
    const link = make("a", { href: URL.createObjectURL(new Blob([text], { type: "application/yaml" })), download: `${this.run.title}-live.yaml` });
    link.click();
    this.saved = text;
  }

  makeFooter() {
    this.pauseButton = make("button", { id: "play", title: "pause or go on (space)", "aria-label": "pause or go on" }, icon("pause"));
    this.pauseButton.addEventListener("click", () => this.ask("pause", !this.paused));
    this.clock = make("span", { class: "time" });
    $("footer").append(this.pauseButton, this.clock, make("span", { class: "gap" }), this.views.box);
    addEventListener("keydown", (event) => {
      if (event.key !== " " || event.target.matches("select, input, button")) return;
      event.preventDefault();
      this.ask("pause", !this.paused);
    });
  }

  async listen() {
    try {
      for await (const block of blocksOf(await fetch("/stream"))) this.take(block);
      this.note = "The loop has ended.";
    } catch (fault) {
      this.note = "The server has ended.";
      this.tellNotes();
      // A stream that breaks is a TypeError, and anything else is a fault of the page.
      if (!(fault instanceof TypeError)) throw fault;
    }
    this.tellNotes();
  }
}

// A slider with its value; on a logarithmic scale where its range is.
class Knob {
  constructor(told, turned) {
    Object.assign(this, told);
    this.input = make("input", { type: "range", min: 0, max: 1000, step: 1, "aria-label": told.text });
    this.output = make("output");
    this.edge = make("i", { class: "mark", hidden: "" });
    this.element = make("label", { class: "knob" }, make("span", {}, told.text), this.output, make("span", { class: "track" }, this.input, this.edge));
    this.set(told.value);
    let waiting = null;
    this.input.addEventListener("input", () => {
      this.tell(this.valueAt(Number(this.input.value) / 1000));
      this.held = performance.now();
      // One question a picture is enough.
      waiting ??= setTimeout(() => ((waiting = null), turned(this.value)), 30);
    });
    this.input.addEventListener("dblclick", () => turned(told.value));
  }

  partOf(value) {
    const part = this.log ? Math.log(value / this.low) / Math.log(this.high / this.low) : (value - this.low) / (this.high - this.low);
    return Math.max(0, Math.min(1, part));
  }

  valueAt(part) {
    const value = this.log ? this.low * (this.high / this.low) ** part : this.low + part * (this.high - this.low);
    return !this.log && Math.abs(value) < 0.004 * (this.high - this.low) ? 0 : value;
  }

  tell(value) {
    this.value = value;
    this.output.textContent = `${this.log ? value.toPrecision(3) : value.toFixed(this.high > 50 ? 0 : 2)} ${this.unit}`.replace("-", "\u2212");
    this.input.setAttribute("aria-valuetext", this.output.textContent);
  }

  // What the server says, unless a hand is on the slider.
  set(value) {
    if (performance.now() - (this.held ?? -1e9) < 400) return;
    this.tell(value);
    this.input.value = 1000 * this.partOf(value);
  }

  mark(value) {
    this.edge.hidden = false;
    this.edge.title = `edge of the promise: ${value.toPrecision(3)}`;
    this.edge.style.left = `calc(8px + ${this.partOf(value)} * (100% - 16px))`;
  }
}

class Switch {
  constructor(told, turned) {
    this.input = make("input", { type: "checkbox", "aria-label": told.text });
    this.element = make("label", { class: "knob switch" }, make("span", {}, told.text), this.input);
    this.set(told.value);
    this.input.addEventListener("change", () => turned(this.input.checked ? 1 : 0));
  }

  set(value) {
    this.input.checked = value > 0;
  }
}

function startLive(header) {
  const live = new Live(header);
  globalThis.echelon = {
    live, run: live.run,
    get time() { return live.moment.time; },
    get pictures() { return live.pictures; },
    get numbers() { return live.numbers; },
    get promise() { return live.promise; },
    position: (agent) => [...live.moment.position.subarray(3 * agent, 3 * agent + 3)],
    goal: (agent) => [...live.moment.goal.subarray(3 * agent, 3 * agent + 3)],
    get links() { return live.run.edges.filter((_, k) => live.view.alive[k]); },
    whereOnScreen: (agent) => live.view.projectAgent(agent),
    ask: (name, value) => live.ask(name, value),
    get saved() { return live.saved; },
  };
}
