// The live page: scene and charts of a stream, and the controls of the loop.

// Seconds that charts show, and that they remember.
const CHART_SECONDS = 30, MEMORY = 600, FLOOR = 1e-17;

// Reads blocks from a stream; each follows its length.
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
    document.body.classList.add("live");
    showHeader(run, $("main"), $(".title"));
    this.moment = new Moment(run.agents);
    this.panel = make("div", { class: "panel" });
    $("#side").append(this.panel);
    this.view = new View($("#scene"), run);
    this.window = new TimeWindow(() => this.charts.forEach((chart) => chart.draw()), CHART_SECONDS);
    this.makeCharts();
    this.views = new ViewControls([this.view], () => this.charts, () => this.show());
    this.views.onlink = (edge) => this.ask(this.view.cut[edge] ? "restore" : "cut", run.edges[edge]);
    this.makeControls(run.knobs, run.choices);
    this.makeFooter();
    this.firstFollower = run.agents > 1 ? [...Array(run.agents).keys()].find((i) => !run.leaders.includes(i)) : 0;
    this.listen();
  }

  // ---- pictures ----

  makeCharts() {
    // V is a square of errors. In a stream, whose pictures are finite, NaN stands for what does not exist.
    const { run } = this, line = (name, colour) => ({ name, colour, values: [], none: "\u2013 none", floor: name === "V" ? FLOOR ** 2 : FLOOR });
    const charts = [{ title: "formation error", unit: run.unit, log: true, lines: [line("worst", 1), line("median", 0), ...(run.referenced ? [line("leader", "leader")] : [])], marks: [{ value: 0.01, name: run.unit ? "1 cm" : "0.01" }] }];
    if (run.near) charts.push({ ...run.near, lines: [line("any two", "leader"), ...(run.ellipsoid.kept ? [{ ...line("active rows", 1), strip: true }] : [])] });
    if (run.limited) charts.push({ title: run.loads ? "motors" : "inputs", unit: "% of limit", log: false, lines: [line("largest", 1), line("smallest", 0)], marks: [{ value: 100, name: "limit", below: true }, { value: 0, name: "limit" }] });
    if (run.lyapunov) charts.splice(1, 0, { title: "Lyapunov function V", unit: "", log: true, lines: [line("V", 0)], marks: [] });
    this.charts = charts.map((chart) => new Chart($("#side"), { ...chart, moments: [], times: [] }, this.window));
  }

  take(block) {
    const data = new DataView(block.buffer, block.byteOffset, block.length);
    if (data.getUint32(0, true) === 1) return void this.receive(JSON.parse(new TextDecoder().decode(block.subarray(4))));
    const numbers = new Float32Array(block.buffer.slice(block.byteOffset + 16, block.byteOffset + block.length));
    this.fill(data.getFloat64(8, true), numbers);
  }

  fill(time, numbers) {
    const { run, moment } = this, { agents, axes, turns, loads } = run;
    const [worst, median, off, most, least, lyapunov, factor, wind, near, active, ...closest] = numbers.subarray(0, 14);
    let at = 14;
    at = this.places(numbers, at, axes, moment.position, time);
    at = this.places(numbers, at, axes, moment.goal, time);
    for (let i = 0; i < agents; i++, at += turns)
      if (turns === 3) moment.setAngles(i, numbers[at], numbers[at + 1], numbers[at + 2]);
      else if (turns) moment.setAngles(i, 0, 0, numbers[at]);
    for (let i = 0; i < agents; i++, at += loads) for (let k = 0; k < loads; k++) moment.motors[4 * i + k] = numbers[at + k];
    if (run.messages) moment.shades = numbers.subarray(at, at + run.edges.length);
    if (this.pictures++ && time < moment.time) this.view.trail.clear();
    this.view.trail.push(moment.position, time);
    moment.time = time;
    this.numbers = { worst, median, off, lyapunov, factor, wind, near, active, closest };
    showClosest($(".closest"), Number.isNaN(closest[0]) ? null : closest, run);
    // A logarithm has no 0, and values below the floor are rounding errors.
    const log = (value, floor = FLOOR) => (value <= floor ? -Infinity : Math.log10(value));
    const rows = [[log(worst), log(median), log(off)], [log(lyapunov, FLOOR ** 2)], [near, active], [100 * most, 100 * least]];
    this.chart(time, rows.filter((_, k) => [true, run.lyapunov, run.near, run.limited][k]));
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
    this.views.update(this.view, this.moment);
  }

  chart(time, rows) {
    this.charts.forEach((chart, place) => {
      if (chart.times.length && time < chart.times[chart.times.length - 1]) (chart.times.length = 0), chart.lines.forEach((line) => (line.values.length = 0)), (this.window.range = null);
      if (time === chart.times[chart.times.length - 1]) return;
      chart.times.push(time);
      chart.lines.forEach((line, k) => line.values.push(rows[place][k]));
      while (chart.times[0] < time - MEMORY) (chart.times.shift(), chart.lines.forEach((line) => line.values.shift()));
    });
    // Charts are drawn a few times a second, which leaves time for the scene.
    const now = performance.now();
    if (now - (this.chartTime ?? 0) < 180) return;
    this.chartTime = now;
    this.window.extend(this.charts[0].times);
    for (const chart of this.charts) (chart.draw(), chart.point(time));
  }

  receive(message) {
    if (message.promise) this.showGuarantee(message.promise);
    if (message.note !== undefined) this.note = message.note;
    if (message.reset) this.view.trail.clear();
    if (message.panel) (this.makeControls(message.panel, message.choices), this.view.setReceivers(message.heard));
    if (message.knobs) this.setState(message);
    this.showNotes();
  }

  showGuarantee(badge) {
    showGuarantee(badge);
    this.promise = badge;
    this.causes = badge.causes ?? [];
    const coupling = this.controls.coupling;
    if (coupling && badge.edge) coupling.mark(badge);
  }

  showNotes() {
    $(".notes").replaceChildren(...[this.note, ...(this.causes ?? []).slice(0, 3)].filter(Boolean).map((words) => make("p", {}, ...prose(words))));
  }

  setState(state) {
    for (const [name, value] of Object.entries({ ...state.knobs, ...state.chosen })) this.controls[name]?.set(value);
    const cut = new Set(state.cut.map(([i, j]) => `${i} ${j}`));
    this.run.edges.forEach(([i, j], edge) => this.view.cutLink(edge, cut.has(`${i} ${j}`)));
    this.state = state;
    this.showMoments(state);
    this.paused = state.paused;
    this.pauseButton.replaceChildren(icon(this.paused ? "play" : "pause"));
  }

  // Shows who leads, and the events.
  showMoments({ moments, nearest }) {
    this.moments = moments;
    this.charts.forEach((chart, place) => (chart.moments = moments.map(([time, words]) => [time, place ? "" : words])));
    showMoment($("main"), moments.at(-1));
    if (nearest.join() === this.nearest) return;
    this.nearest = nearest.join();
    this.view.setLeaders(nearest);
  }

  // ---- requests ----

  async ask(name, value) {
    try {
      const response = await fetch("/knob", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ name, value }) });
      const answer = await response.json();
      if (answer.fault) this.showFault(answer.fault);
      return answer;
    } catch {
      this.note = "The server has stopped.";
      this.showNotes();
      return {};
    }
  }

  // Shows the reason of a refused request for a while, and restores the controls.
  showFault(words) {
    this.note = words;
    this.showNotes();
    setTimeout(() => this.note === words && ((this.note = ""), this.showNotes()), 12000);
    for (const control of Object.values(this.controls)) control.touched = -1e9;
    if (this.state) this.setState(this.state);
  }

  // The controls of the present law.
  makeControls(sliders, choices) {
    this.controls = {};
    this.panel.replaceChildren();
    for (const slider of sliders) {
      const request = (value) => this.ask(slider.name, value);
      const control = slider.name === "feedforward" ? new Switch(slider, request) : new Slider(slider, request);
      this.controls[slider.name] = control;
      this.panel.append(control.element);
    }
    this.shapes = choices.shape;
    const words = { law: "law", method: "gain method", shape: "shape" };
    const rows = Object.entries(choices).filter(([, names]) => names.length > 1);
    this.panel.append(make("div", { class: "choices" }, ...rows.map(([name, names]) => this.makeChoice(name, words[name], names))));
    this.makeButtons();
  }

  makeButtons() {
    const button = (words, title, action) => {
      const element = make("button", { title }, words);
      element.addEventListener("click", action);
      return element;
    };
    this.panel.append(make("div", { class: "buttons" },
      button("kick", "push the selected agent, else the first follower (k)", () => this.kick()),
      button("lose agent", "the selected agent is lost, else the last follower", () => this.lose()),
      button("join", "the selected agent joins again, else the one lost last", () => this.join()),
      ...(this.shapes.length > 1 ? [button("reshape", "agents move to the next shape within 3 s", () => this.reshape())] : []),
      button("reset", "restart with the present controls", () => this.ask("reset")),
      button("save as scenario", "download a scenario file that repeats this session", () => this.save())));
    this.panel.append(make("p", { class: "hint" }, "click a link to cut or restore it, or an agent to select it"));
  }

  // A list of options; `scenario` stands for the scenario's own.
  makeChoice(name, words, names) {
    const select = make("select", { "aria-label": words });
    for (const option of names) select.append(make("option", { value: option }, option === "scenario" ? "as in the scenario" : option));
    const set = (value) => (select.value = value ?? "scenario");
    // A refused choice is undone.
    select.addEventListener("change", async () => {
      const answer = await this.ask(name, select.value);
      if (answer.fault) set(this.state?.chosen[name]);
    });
    this.controls[name] = { set };
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
    this.pauseButton = make("button", { id: "play", title: "pause or continue (space)", "aria-label": "pause or continue" }, icon("pause"));
    this.pauseButton.addEventListener("click", () => this.ask("pause", !this.paused));
    this.clock = make("span", { class: "time" });
    $("footer").append(this.pauseButton, this.clock, make("span", { class: "gap" }), this.views.box);
    listenKeys({
      " ": ["pause, continue", () => this.ask("pause", !this.paused)],
      k: ["kick the selected agent, else the first follower", () => this.kick()],
      r: ["restart with the present controls", () => this.ask("reset")],
      ...this.views.keys,
    });
  }

  lose() {
    const { selected } = this.view, present = [...Array(this.run.agents).keys()].filter((i) => !this.absent(i));
    this.ask("lose", selected >= 0 ? selected : present.filter((i) => !this.run.leaders.includes(i)).at(-1) ?? present[0]);
  }

  absent(agent) {
    return Number.isNaN(this.moment.position[3 * agent + 1]);
  }

  join() {
    const { selected } = this.view, absent = [...Array(this.run.agents).keys()].filter((i) => this.absent(i));
    if (selected >= 0 || absent.length) this.ask("join", selected >= 0 ? selected : absent.at(-1));
    else this.showFault("Nobody is lost who could join; press `lose agent` first.");
  }

  reshape() {
    const present = this.state?.chosen.shape ?? "scenario", names = this.shapes;
    this.ask("reshape", names[(names.indexOf(present) + 1) % names.length]);
  }

  kick() {
    this.ask("kick", this.view.selected >= 0 ? this.view.selected : this.firstFollower);
  }

  async listen() {
    try {
      for await (const block of blocksOf(await fetch("/stream"))) this.take(block);
      this.note = "The loop has stopped.";
    } catch (fault) {
      this.note = "The server has stopped.";
      this.showNotes();
      // A broken stream is a TypeError; any other error is a fault of the page.
      if (!(fault instanceof TypeError)) throw fault;
    }
    this.showNotes();
  }
}

// A slider with its value, linear or logarithmic.
class Slider {
  constructor(slider, request) {
    Object.assign(this, slider);
    this.input = make("input", { type: "range", min: 0, max: 1000, step: 1, "aria-label": slider.text });
    this.output = make("output");
    this.edge = make("i", { class: "mark", hidden: "" });
    this.end = make("i", { class: "mark end", hidden: "" });
    this.element = make("label", { class: "knob" }, make("span", {}, slider.text), this.output, make("span", { class: "track" }, this.input, this.edge, this.end));
    this.set(slider.value);
    let timer = null;
    this.input.addEventListener("input", () => {
      this.show(this.valueAt(Number(this.input.value) / 1000));
      this.touched = performance.now();
      // One request per picture is enough.
      timer ??= setTimeout(() => ((timer = null), request(this.value)), 30);
    });
    this.input.addEventListener("dblclick", () => request(slider.value));
  }

  partOf(value) {
    const part = this.log ? Math.log(value / this.low) / Math.log(this.high / this.low) : (value - this.low) / (this.high - this.low);
    return Math.max(0, Math.min(1, part));
  }

  valueAt(part) {
    const value = this.log ? this.low * (this.high / this.low) ** part : this.low + part * (this.high - this.low);
    return !this.log && Math.abs(value) < 0.004 * (this.high - this.low) ? 0 : value;
  }

  show(value) {
    this.value = value;
    this.output.textContent = `${this.log ? value.toPrecision(3) : value.toFixed(this.high > 50 ? 0 : 2)} ${this.unit}`.replace("-", "\u2212");
    this.input.setAttribute("aria-valuetext", this.output.textContent);
  }

  // Takes the server's value, unless the person is moving the slider.
  set(value) {
    if (performance.now() - (this.touched ?? -1e9) < 400) return;
    this.show(value);
    this.input.value = 1000 * this.partOf(value);
  }

  // Marks from where on modes are guaranteed to decay, and from where on they grow in held steps.
  mark({ edge, above, end }) {
    const put = (element, value, words) => {
      element.hidden = !value;
      if (!value) return;
      element.title = words;
      element.style.left = `calc(8px + ${this.partOf(value)} * (100% - 16px))`;
    };
    put(this.edge, edge, `modes are guaranteed to decay above ${above}${end ? `, up to about ${end.toPrecision(3)}` : ""}`);
    put(this.end, end, end && `errors grow in the steps of the loop from about ${end.toPrecision(3)} on`);
  }
}

class Switch {
  constructor(slider, request) {
    this.input = make("input", { type: "checkbox", "aria-label": slider.text });
    this.element = make("label", { class: "knob switch" }, make("span", {}, slider.text), this.input);
    this.set(slider.value);
    this.input.addEventListener("change", () => request(this.input.checked ? 1 : 0));
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
