// A run that is still being computed: replays one after the other, each beginning where the one
// before ended, behind what a player asks of one.

class Growing {
  constructor(header) {
    Object.assign(this, header, { parts: [], starts: [], frames: 1, charts: [], chartTimes: [] });
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
    const length = new DataView(data).getUint32(0, true);
    const part = new Replay(JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length))), new Uint8Array(data, 4 + length));
    const first = !this.parts.length;
    part.moment = this.moment;
    this.starts.push(first ? 0 : this.frames - 1);
    this.parts.push(part);
    this.frames = this.starts[this.starts.length - 1] + part.frames;
    const charts = readCharts(part), from = first ? 0 : 1;
    if (first) this.charts = charts.map((chart) => ({ ...chart, times: this.chartTimes, lines: chart.lines.map((line) => ({ ...line, values: [] })) }));
    this.chartTimes.push(...part.chartTimes.slice(from));
    charts.forEach((chart, k) => chart.lines.forEach((line, n) => {
      const { ends, values } = this.charts[k].lines[n] ?? {};
      if (!values) return;
      const times = part.chartTimes.slice(from);
      // What is promised begins where the run began.
      values.push(...(ends ? times.map((t) => ends[0] + ends[1] * t) : line.values.slice(from)));
    }));
  }

  partOf(found) {
    let k = this.parts.length - 1;
    while (k > 0 && !found(k)) k--;
    return k;
  }

  timeOf(frame) {
    const k = this.partOf((k) => this.starts[k] <= frame);
    return this.parts[k].timeOf(frame - this.starts[k]);
  }

  frameOf(time) {
    if (!this.parts.length) return 0;
    const k = this.partOf((k) => this.parts[k].timeOf(0) <= time);
    return this.starts[k] + this.parts[k].frameOf(time);
  }

  at(frame) {
    if (!this.parts.length) return this.moment;
    const k = this.partOf((k) => this.starts[k] <= frame);
    return this.parts[k].at(frame - this.starts[k]);
  }
}

// Asks for one stretch after the other, and for the whole run at the end.
async function feed(run, player) {
  for (;;) {
    let answer;
    try {
      answer = await fetch(`/stretch/${run.parts.length}`);
    } catch {
      return void player.tell("The run has ended, or its server: what came is kept here.");
    }
    if (answer.status === 205) return void player.reload();
    if (answer.status === 204) continue;
    // Who looks at the newest frame goes on to look at it.
    const newest = player.frame >= run.frames - 1.5 && !player.playing;
    const raw = answer.body.pipeThrough(new DecompressionStream("deflate"));
    run.add(await new Response(raw).arrayBuffer());
    player.grow(newest);
  }
}
