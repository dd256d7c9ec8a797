// A run that is still being computed: a sequence of replays with the interface of one replay.

class Growing {
  constructor(header) {
    Object.assign(this, header, { parts: [], starts: [], frames: 1, charts: [], chartTimes: [], path: [], closest: [] });
    this.offsets = expand(header.offsets, header.agents, header.space);
    this.moment = new Moment(header.agents);
    this.moment.setGoals(this);
  }

  get clock() {
    return { last: this.horizon };
  }

  // The time until which there are frames.
  get reached() {
    return this.parts.length ? this.timeOf(this.frames - 1) : 0;
  }

  add(data) {
    const part = readRun(data);
    const first = !this.parts.length;
    part.moment = this.moment;
    this.starts.push(first ? 0 : this.frames - 1);
    this.parts.push(part);
    this.frames = this.starts[this.starts.length - 1] + part.frames;
    this.path.push(...(part.path ?? []));
    this.closest.push(...part.closest.filter(([, distance]) => !(distance >= this.closest.at(-1)?.[1])));
    const charts = readCharts(part), from = first ? 0 : 1;
    if (first) this.charts = charts.map((chart) => ({ ...chart, times: this.chartTimes, lines: chart.lines.map((line) => ({ ...line, values: [] })) }));
    this.chartTimes.push(...part.chartTimes.slice(from));
    charts.forEach((chart, k) => chart.lines.forEach((line, n) => {
      const { ends, values } = this.charts[k].lines[n] ?? {};
      if (!values) return;
      const times = part.chartTimes.slice(from);
      // The guaranteed slope starts where the run started.
      values.push(...(ends ? times.map((t) => ends[0] + ends[1] * t) : line.values.slice(from)));
    }));
  }

  lastPart(matches) {
    let k = this.parts.length - 1;
    while (k > 0 && !matches(k)) k--;
    return k;
  }

  timeOf(frame) {
    const k = this.lastPart((k) => this.starts[k] <= frame);
    return this.parts[k].timeOf(frame - this.starts[k]);
  }

  frameOf(time) {
    if (!this.parts.length) return 0;
    const k = this.lastPart((k) => this.parts[k].timeOf(0) <= time);
    return this.starts[k] + this.parts[k].frameOf(time);
  }

  at(frame) {
    if (!this.parts.length) return this.moment;
    const k = this.lastPart((k) => this.starts[k] <= frame);
    return this.parts[k].at(frame - this.starts[k]);
  }
}

// Loads one part after the other, and the complete run at the end.
async function loadParts(run, player) {
  for (;;) {
    let response;
    try {
      response = await fetch(`/stretch/${run.parts.length}`);
    } catch {
      return void player.showNote("The connection has ended; the page keeps the part that it received.");
    }
    if (response.status === 205) return void player.reload();
    if (response.status === 204) continue;
    // A person at the newest frame stays at the newest frame.
    const newest = player.frame >= run.frames - 1.5 && !player.playing;
    const raw = response.body.pipeThrough(new DecompressionStream("deflate"));
    run.add(await new Response(raw).arrayBuffer());
    player.grow(newest);
  }
}
