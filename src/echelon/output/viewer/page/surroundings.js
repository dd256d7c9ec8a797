// Around the agents: trails, the grid with its numbers, and names.

// Trails: segments lie in the index buffer by time, so that the last seconds are one range of it.
class Trail {
  constructor(run, flat) {
    const few = run.agents <= 12;
    this.agents = run.agents;
    this.live = !run.positions;
    // Short in a large swarm, where long ones would hide each other.
    this.overTime = run.space.kind === "time";
    this.seconds = this.overTime ? (this.live ? run.duration : 1e9) : few ? Math.min(8, 0.4 * run.duration) : run.agents > 200 ? 1 : 3;
    if (run.space.kind === "phase") this.seconds = Math.max(this.seconds, 0.3 * run.duration);
    const apart = few ? 0.02 : run.agents > 200 ? 0.2 : 0.08;
    this.stride = Math.max(1, Math.round(apart / run.clock.step));
    if (run.agents * (this.live ? 0 : run.frames / this.stride) > 4e5) this.stride = Math.ceil((run.agents * run.frames) / 4e5);
    this.apart = this.stride * run.clock.step;
    this.steps = this.live ? Math.ceil(this.seconds / this.apart) : Math.floor((run.frames - 1) / this.stride);
    this.times = [];
    this.geometry = this.live ? this.empty() : this.recorded(run);
    this.geometry.setDrawRange(0, this.live ? Infinity : 0);
  }

  recorded(run) {
    const places = [];
    for (let s = 0; s <= this.steps; s++) {
      this.times.push(run.timeOf(s * this.stride));
      places.push(run.at(s * this.stride).position.slice());
    }
    const at = (r, later) => {
      const s = Math.floor(r / this.agents), i = r % this.agents;
      return places[s + later].subarray(3 * i, 3 * i + 3);
    };
    return ribbons(this.steps * this.agents, {
      first: [3, (r) => at(r, 0)],
      second: [3, (r) => at(r, 1)],
      agent: [1, (r) => [r % this.agents]],
      when: [1, (r) => [this.times[Math.floor(r / this.agents) + 1]]],
    });
  }

  empty() {
    [this.next, this.last, this.before] = [0, NaN, new Float32Array(3 * this.agents)];
    return ribbons(this.steps * this.agents, {
      first: [3, () => [0, 0, 0]],
      second: [3, () => [0, 0, 0]],
      agent: [1, (r) => [r % this.agents]],
      when: [1, () => [-1e9]],
    });
  }

  // In a stream the newest segments replace the oldest.
  push(now, time) {
    const { before } = this;
    if (!(time < this.last + this.apart - 1e-6)) {
      // A picture over time starts again at its left edge.
      if (time > this.last && !(this.overTime && now[0] < before[0])) this.pushSegments(before, now, time);
      before.set(now);
      this.last = time;
    }
  }

  pushSegments(before, now, time) {
    const parts = ["first", "second", "when"].map((name) => this.geometry.getAttribute(name));
    const [first, second, when] = parts.map((part) => part.array), base = 4 * this.agents * (this.next++ % this.steps);
    for (let i = 0; i < 3 * this.agents; i++)
      for (let k = 0, at = 3 * base + 12 * Math.floor(i / 3) + (i % 3); k < 4; k++, at += 3) (first[at] = before[i]), (second[at] = now[i]);
    when.fill(time, base, base + 4 * this.agents);
    for (const part of parts) (part.addUpdateRange(base * part.itemSize, 4 * this.agents * part.itemSize), (part.needsUpdate = true));
  }

  clear() {
    const when = this.geometry.getAttribute("when");
    when.array.fill(-1e9);
    when.needsUpdate = true;
    this.last = NaN;
  }

  window(geometry, time) {
    if (this.live) return;
    const end = upper(this.times, time), start = upper(this.times, time - this.seconds);
    const first = Math.max(0, start - 1), last = Math.max(0, Math.min(this.steps, end - 1));
    geometry.setDrawRange(6 * this.agents * first, 6 * this.agents * Math.max(0, last - first));
  }
}

// The paths that leaders should follow: all of a recorded one, the first minute of a stream.
class Path {
  constructor(view, lines) {
    Object.assign(this, { view, mesh: view.add(new THREE.BufferGeometry(), view.material(PATH, lines), 0) });
    this.place(view.run.path ?? []);
  }

  // Draws lines through places of the reference, each of three numbers.
  place(places) {
    const { run } = this.view, segments = [];
    for (const leader of run.leaders.slice(0, 12)) {
      const at = (k) => places[k].map((value, axis) => value + (run.space.kind === "time" && !axis ? 0 : run.offsets[3 * leader + axis]));
      for (let k = 1; k < places.length; k++) segments.push([at(k - 1), at(k), k]);
    }
    this.mesh.geometry.dispose();
    this.mesh.geometry = ribbons(segments.length, {
      first: [3, (r) => segments[r][0]],
      second: [3, (r) => segments[r][1]],
      along: [1, (r) => [segments[r][2]]],
    });
  }
}

// The ellipsoids about agents, of which those too near to each other are always drawn.
class Ellipsoids {
  constructor(view, lines) {
    const { run, shared } = view, { radii, kept } = run.ellipsoid;
    this.run = run;
    shared.radii = { value: [0, 1, 2].map((k) => radii[k] ?? 0.01) };
    this.shown = shared.ellipsoids = { value: kept ? 1 : 0 };
    view.add(ellipsoids(run.agents), view.material(ELLIPSOID, lines), 4);
  }

  // Of each agent 2 if another is nearer than the limit, 4 if their ellipsoids overlap, else 0.
  marks(p) {
    const { agents } = this.run, { radii, touching, limit } = this.run.ellipsoid;
    const marks = new Uint8Array(agents), scale = [0, 1, 2].map((k) => touching / 2 / (radii[k] ?? Infinity));
    for (let i = 0; i < agents; i++)
      for (let j = 0; j < i; j++) {
        const far = Math.hypot(...scale.map((s, k) => s * (p[3 * i + k] - p[3 * j + k])));
        // Places are rounded in the page.
        const mark = far < touching ? 4 : far < limit - 1e-4 ? 2 : 0;
        for (const agent of [i, j]) marks[agent] = Math.max(marks[agent], mark);
      }
    return marks;
  }
}

// Tells how many agents are outside of the picture, with a way to show them.
class Away {
  constructor(view) {
    Object.assign(this, { view, checked: -1e9, button: make("button", { class: "away", hidden: "" }) });
    this.button.addEventListener("click", () => this.onshow?.());
    view.element.append(this.button);
  }

  // A few times a second is enough.
  count(now) {
    const { view } = this, { agents } = view.run;
    clearTimeout(this.later);
    if (now - this.checked < 200) return void (this.later = setTimeout(() => this.count(performance.now()), 220));
    this.checked = now;
    if (!view.moment) return;
    const [w, h] = [view.element.clientWidth, view.element.clientHeight];
    let out = 0;
    for (let i = 0; i < agents; i++) {
      const at = view.projectAgent(i), p = view.moment.position;
      if (!Number.isFinite(p[3 * i])) continue;
      if (!at || at[0] < 0 || at[1] < 0 || at[0] > w || at[1] > h) out++;
    }
    this.button.hidden = !out;
    this.button.textContent = `${out} ${out > 1 ? "agents" : "agent"} out of view \u00b7 show all`;
  }
}

// The number of sorted values up to a limit.
function upper(sorted, value) {
  let [low, high] = [0, sorted.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (sorted[middle] <= value + 1e-9) low = middle + 1;
    else high = middle;
  }
  return low;
}

// A step of 1, 2 or 5 times a power of ten that gives about a number of ticks.
function niceStep(range, count) {
  const power = 10 ** Math.floor(Math.log10(range / count));
  return power * [1, 2, 5, 10].find((m) => m * power * count >= range * 0.999);
}

function ticks(low, high, step) {
  const out = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) out.push(k * step);
  return out;
}

function format(value, step) {
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  if (digits > 4 || step >= 1e5) return Math.abs(value) < step / 2 ? "0" : brief(value);
  return (Math.abs(value) < step / 2 ? 0 : value).toFixed(digits).replace("-", "\u2212");
}

// The grid with its numbers, on a canvas behind the scene.
class Backdrop {
  constructor(view) {
    this.view = view;
    this.canvas = document.createElement("canvas");
    this.canvas.className = "backdrop";
  }

  resize(w, h) {
    const ratio = Math.min(2, devicePixelRatio);
    [this.w, this.h, this.ratio, this.key] = [w, h, ratio, ""];
    this.canvas.width = Math.round(w * ratio);
    this.canvas.height = Math.round(h * ratio);
  }

  draw() {
    const { camera, orbit } = this.view;
    const key = [...camera.position, ...orbit.target, camera.zoom, this.w, this.h, themeColour("--grid")].join();
    if (key === this.key) return;
    this.key = key;
    const pen = (this.pen = this.canvas.getContext("2d"));
    pen.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    pen.clearRect(0, 0, this.w, this.h);
    pen.font = "11px system-ui, sans-serif";
    pen.fillStyle = themeColour("--faint");
    if (this.view.flat) this.drawFlat();
    else this.drawFloor();
  }

  line(a, b, strong) {
    if (!a || !b) return;
    const { pen } = this;
    pen.strokeStyle = themeColour(strong ? "--axis" : "--grid");
    pen.lineWidth = 1;
    pen.beginPath();
    pen.moveTo(...a);
    pen.lineTo(...b);
    pen.stroke();
  }

  text(words, x, y, align, base = "middle") {
    Object.assign(this.pen, { textAlign: align, textBaseline: base });
    this.pen.fillText(words, x, y);
  }

  // Lines through the whole view, with numbers at the left and at the bottom.
  drawFlat() {
    const { view, w, h } = this, { space } = view.run, [sx, sy] = space.stretch;
    const half = [w, h].map((size) => size / 2 / view.camera.zoom), at = view.camera.position;
    const range = [[at.x - half[0], at.x + half[0], sx], [at.y - half[1], at.y + half[1], sy]];
    const even = niceStep(2 * half[0] / sx, w / 90);
    const [xs, ys] = range.map(([low, high, s], k) => {
      // One step for both axes if they have the same scale.
      const step = sx === sy ? even : niceStep((high - low) / s, [w / 90, h / 60][k]);
      return ticks(low / s, high / s, step).map((value) => [value, s * value, step]);
    });
    for (const [value, x] of xs) this.line([view.project(x, 0, 0)[0], 0], [view.project(x, 0, 0)[0], h], !value);
    for (const [value, y] of ys) this.line([0, view.project(0, y, 0)[1]], [w, view.project(0, y, 0)[1]], !value);
    for (const [value, x, step] of xs) this.text(format(value, step), view.project(x, 0, 0)[0] + 4, h - 12, "left");
    for (const [value, y, step] of ys) this.text(format(value, step), 8, view.project(0, y, 0)[1] - 8, "left");
    this.pen.fillStyle = themeColour("--ink");
    const name = (k) => space.names[k].replaceAll("_", " ") + (space.units[k] ? `, ${space.units[k]}` : "");
    this.text(name(0), w - 10, h - 28, "right");
    this.text(name(1), 40, 14, "left");
  }

  // A floor larger than the box, with numbers along the two sides that face the camera.
  drawFloor() {
    const { view } = this, { low, high } = view.run.box, floor = low[2], at = view.camera.position;
    const size = Math.max(high[0] - low[0], high[1] - low[1]), step = niceStep(size, 8);
    const [x, y] = [0, 1].map((k) => [Math.floor(low[k] / step + 0.2) * step, Math.ceil(high[k] / step - 0.2) * step]);
    const put = (a, b) => view.project(a, b, floor);
    for (const value of ticks(...x, step)) this.line(put(value, y[0]), put(value, y[1]), Math.abs(value) < step / 9);
    for (const value of ticks(...y, step)) this.line(put(x[0], value), put(x[1], value), Math.abs(value) < step / 9);
    const front = at.y < view.middle.y ? y[0] : y[1], side = at.x < view.middle.x ? x[0] : x[1];
    const out = 0.35 * step, beyond = (edge, [a, b]) => edge + (edge === a ? -out : out);
    const write = (words, place) => place && this.text(words, ...place, "center");
    for (const value of ticks(...x, 2 * step)) write(format(value, step), put(value, beyond(front, y)));
    for (const value of ticks(...y, 2 * step)) write(format(value, step), put(beyond(side, x), value));
    this.pen.fillStyle = themeColour("--ink");
    const { names, units } = view.run.space, unit = (k) => (units[k] ? `, ${units[k]}` : "");
    write(names[0] + unit(0), put((x[0] + x[1]) / 2 + step / 2, beyond(beyond(front, y), y)));
    write(names[1] + unit(1), put(beyond(beyond(side, x), x), (y[0] + y[1]) / 2 + step / 2));
    this.drawHeight(step, front === y[0] ? y[1] : y[0], side, floor);
  }

  // The height axis, at a corner at the edge of the view.
  drawHeight(step, y, x, floor) {
    const { view } = this, top = Math.max(view.run.box.high[2], floor + step);
    const apart = niceStep(top - floor, 3), { names, units } = view.run.space;
    const last = Math.ceil(top / apart - 1e-9) * apart;
    this.line(view.project(x, y, floor), view.project(x, y, last), true);
    this.pen.fillStyle = themeColour("--faint");
    for (const value of ticks(floor + apart / 2, last, apart)) {
      const at = view.project(x, y, value);
      if (at) (this.line(at, [at[0] - 5, at[1]], true), this.text(format(value, apart), at[0] - 8, at[1], "right"));
    }
    this.pen.fillStyle = themeColour("--ink");
    const at = view.project(x, y, last);
    const name = names[2] + (units[2] ? `, ${units[2]}` : ""), half = this.pen.measureText(name).width / 2 + 4;
    // At the top of the picture the name is beside the highest number instead of above it.
    if (at && at[1] < 18) this.text(name, at[0] - 26, Math.max(8, at[1]), "right");
    else if (at) this.text(name, Math.min(this.w - half, at[0]), at[1] - 10, "center");
  }
}

// Names of all agents, or of the leaders of a large swarm.
class Labels {
  constructor(view) {
    const { run } = view;
    this.view = view;
    this.visible = true;
    const named = run.agents <= 12 ? [...Array(run.agents).keys()] : run.agents <= 60 ? run.leaders.slice(0, 12) : [];
    this.all = named.map((agent) => {
      const label = document.createElement("span");
      view.element.append(label);
      return [agent, label];
    });
    this.rename();
  }

  rename() {
    const { leaders } = this.view.run;
    for (const [agent, label] of this.all) {
      const leads = leaders.includes(agent);
      label.className = leads ? "label leader" : "label";
      label.textContent = leads ? (leaders.length > 1 ? `leader ${agent}` : "leader") : agent;
    }
  }

  place() {
    const { view } = this, p = view.moment?.position;
    if (!p) return;
    for (const [agent, label] of this.all) {
      const up = view.flat ? [0, 0.3 * view.run.size, 0] : [0, 0, 0.4 * view.run.size];
      const at = view.project(...up.map((value, k) => p[3 * agent + k] + value));
      label.hidden = !at || !this.visible;
      if (at) label.style.transform = `translate(${at[0].toFixed(1)}px, ${at[1].toFixed(1)}px) translate(-50%, -110%)`;
    }
  }
}
