// A chart over time on a canvas; the cursor is an element that moves over it.

const RAISED = "\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079";
const raise = (k) => "10" + (k < 0 ? "\u207b" : "") + [...String(Math.abs(k))].map((digit) => RAISED[digit]).join("");
const MARGIN = { left: 46, right: 14, top: 6, bottom: 20 };

const NOT_FINITE = "\u2013 not finite";

// A number with three digits; a dash and the reason for what is none.
function brief(value) {
  if (!Number.isFinite(value)) return NOT_FINITE;
  const size = Math.abs(value);
  if (!size) return "0";
  if (size < 1e-3 || size >= 1e5) {
    const power = Math.floor(Math.log10(size));
    return `${(value / 10 ** power).toFixed(1)}\u00b7${raise(power)}`.replace("-", "\u2212");
  }
  // From 1000 on all digits before the point are shown.
  return (size >= 1e3 ? value.toFixed(0) : value.toPrecision(3)).replace("-", "\u2212");
}

// The part of time that all charts show: all of it, or a stream's last seconds, until it is zoomed.
class TimeWindow {
  // `latest` is the length (s) that a stream shows; without it all is shown.
  constructor(draw, latest = Infinity) {
    Object.assign(this, { draw, latest, whole: null, range: null });
  }

  // Takes the times for which there are values. A window that ends at the newest time keeps to it.
  extend(times) {
    if (times.length < 2) return;
    const before = this.whole?.[1], [low, high] = [times[0], times[times.length - 1]];
    // Two runs beside each other have one window.
    this.whole = this.whole && this.latest === Infinity ? [Math.min(this.whole[0], low), Math.max(before, high)] : [low, high];
    if (this.range) this.set(this.range.map((t) => t + (this.range[1] >= before ? high - before : 0)));
  }

  get span() {
    const [low, high] = this.whole ?? [0, 1];
    return this.range ?? [Math.max(low, high - this.latest), high];
  }

  set([low, high]) {
    const [first, last] = this.whole, length = Math.max(1e-4 * (last - first), Math.min(high - low, last - first));
    const start = Math.max(first, Math.min(last - length, low));
    this.range = length >= last - first && this.latest === Infinity ? null : [start, start + length];
  }

  // Stretches time by a factor about a time that stays, then moves it by seconds. A stream keeps its newest time.
  change(factor, at, shift = 0) {
    if (this.latest < Infinity && !shift && this.whole && this.span[1] >= this.whole[1]) at = this.span[1];
    this.set(this.span.map((t) => at + factor * (t - at) + shift));
    this.draw();
  }

  reset() {
    this.range = null;
    this.draw();
  }
}

class Chart {
  // The chart has title, unit, log, lines and marks; `seek` is called with a selected time.
  constructor(element, chart, window, seek) {
    Object.assign(this, chart, { window, seek, fingers: new Map() });
    this.element = document.createElement("figure");
    this.element.className = "chart";
    this.element.innerHTML = `<figcaption><b></b><span class="legend"></span></figcaption>
      <div class="area"><canvas></canvas><div class="cursor"></div><button class="reset" hidden>reset zoom</button></div>`;
    this.element.querySelector("b").textContent = this.unit ? `${this.title}, ${this.unit}` : this.title;
    element.append(this.element);
    this.canvas = this.element.querySelector("canvas");
    this.cursor = this.element.querySelector(".cursor");
    this.area = this.element.querySelector(".area");
    this.makeLegend();
    this.listen();
    new ResizeObserver(() => this.draw()).observe(this.area);
  }

  makeLegend() {
    const legend = this.element.querySelector(".legend");
    this.readouts = this.lines.map((line) => {
      if (line.name === null) return null;
      const entry = document.createElement("span"), value = document.createElement("i");
      entry.style.setProperty("--colour", this.colour(line));
      entry.className = line.dash ? "dashed" : "";
      entry.append(line.name, " ", value);
      legend.append(entry);
      return value;
    });
  }

  colour({ colour }) {
    return typeof colour === "number" ? PALETTE[colour % PALETTE.length] : `var(--${colour})`;
  }

  // A click selects a time, and so does a drag, unless a part is shown: then it moves that part.
  listen() {
    const { area, fingers } = this;
    area.addEventListener("pointerdown", (event) => {
      if (event.target.closest(".reset")) return;
      area.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, event.clientX);
      this.moved = 0;
      this.pans = !this.seek || (this.window.range && Math.abs(this.across(event) - this.x(this.now)) > 12);
      // A finger may be about to scroll.
      if (!this.pans && event.pointerType !== "touch") this.seek(this.timeAt(event));
    });
    area.addEventListener("pointermove", (event) => fingers.has(event.pointerId) && this.drag(event));
    area.addEventListener("pointerup", (event) => {
      if (this.seek && fingers.size === 1 && this.moved < 4) this.seek(this.timeAt(event));
    });
    for (const end of ["pointerup", "pointercancel"]) area.addEventListener(end, (event) => fingers.delete(event.pointerId));
    area.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(1.0015 ** event.deltaY, event);
    }, { passive: false });
    area.addEventListener("dblclick", () => this.reset());
    area.querySelector(".reset").addEventListener("click", () => this.reset());
  }

  // One finger or the mouse moves time or the part that is shown; two fingers stretch it.
  drag(event) {
    const { fingers, window } = this, before = [...fingers.values()], second = 1 / this.perSecond();
    this.moved += Math.abs(event.clientX - fingers.get(event.pointerId));
    fingers.set(event.pointerId, event.clientX);
    const now = [...fingers.values()];
    if (fingers.size > 1) {
      const apart = ([a, b]) => Math.max(20, Math.abs(a - b)), middle = ([a, b]) => (a + b) / 2;
      this.pans = true;
      window.change(apart(before) / apart(now), this.timeAt({ clientX: middle(now) }), (middle(before) - middle(now)) * second);
    } else if (this.pans) window.change(1, 0, (before[0] - now[0]) * second);
    else this.seek(this.timeAt(event));
  }

  // Over the numbers at the left the value axis is stretched, else time.
  zoom(factor, event) {
    if (this.across(event) >= MARGIN.left) return void this.window.change(factor, this.timeAt(event));
    const { height, top } = this.area.getBoundingClientRect(), [low, high] = this.limits;
    const part = (height - MARGIN.bottom - event.clientY + top) / (height - MARGIN.top - MARGIN.bottom);
    const at = low + part * (high - low);
    // A logarithmic axis has numbers at whole powers of ten alone.
    if (this.log && factor * (high - low) < 1) return;
    this.values = [low, high].map((v) => at + factor * (v - at));
    this.draw();
  }

  reset() {
    this.values = null;
    this.draw();
    this.window.reset();
  }

  across(event) {
    return event.clientX - this.area.getBoundingClientRect().left;
  }

  perSecond() {
    const [low, high] = this.window.span;
    return (this.area.clientWidth - MARGIN.left - MARGIN.right) / (high - low || 1);
  }

  timeAt(event) {
    const [low, high] = this.window.span, time = low + (this.across(event) - MARGIN.left) / this.perSecond();
    return Math.max(low, Math.min(high, time));
  }

  // The places in `times` of the part that is shown, and one more on each side.
  shown() {
    const [low, high] = this.window.span;
    return [Math.max(0, upper(this.times, low) - 2), Math.min(this.times.length, upper(this.times, high) + 1)];
  }

  // The limits of the value axis; of a logarithmic one as exponents. Two runs have one scale.
  reach() {
    if (this.values) return this.values;
    const twins = [this, this.twin].flatMap((chart) => chart?.ownReach() ?? []);
    return [Math.min(...twins), Math.max(...twins)];
  }

  ownReach() {
    let [low, high] = [Infinity, -Infinity];
    const take = (y) => Number.isFinite(y) && ((low = Math.min(low, y)), (high = Math.max(high, y)));
    const [start, end] = this.shown();
    for (const line of this.lines) if (!line.bound && !line.strip) for (let k = start; k < end; k++) take(line.values[k]);
    for (const mark of this.marks) take(this.log ? Math.log10(mark.value) : mark.value);
    if (this.zero) take(0);
    if (!(low <= high)) return this.log ? [-1, 0] : [0, 1];
    if (this.log) return high - low > 2 ? [low - 0.15, high + 0.25] : [Math.floor(low - 0.05), Math.ceil(high + 0.05)];
    const margin = 0.06 * (high - low) || 0.1 * Math.abs(high) || 1;
    return [this.zero ? 0 : low - margin, high + margin];
  }

  draw() {
    const [w, h] = [this.area.clientWidth, this.area.clientHeight], ratio = Math.min(2, devicePixelRatio);
    if (!w || !h) return;
    Object.assign(this.canvas, { width: Math.round(w * ratio), height: Math.round(h * ratio) });
    const pen = this.canvas.getContext("2d"), [first, last] = this.window.span, [low, high] = (this.limits = this.reach());
    pen.scale(ratio, ratio);
    pen.font = "11px system-ui, sans-serif";
    this.x = (t) => MARGIN.left + ((t - first) / (last - first || 1)) * (w - MARGIN.left - MARGIN.right);
    this.y = (v) => h - MARGIN.bottom - ((v - low) / (high - low)) * (h - MARGIN.top - MARGIN.bottom);
    this.drawGrid(pen, low, high, first, last, w, h);
    this.area.querySelector(".reset").hidden = !this.window.range && !this.values;
    pen.save();
    pen.beginPath();
    pen.rect(MARGIN.left, MARGIN.top - 2, w - MARGIN.left - MARGIN.right, h - MARGIN.top - MARGIN.bottom + 4);
    pen.clip();
    this.drawMarks(pen, w);
    this.drawMoments(pen, w, h);
    for (const line of this.lines) line.strip ? this.drawStrip(pen, line, h) : this.drawLine(pen, line);
    this.nameMarks(pen, w);
    pen.restore();
    if (this.now !== undefined) this.point(this.now);
  }

  drawGrid(pen, low, high, first, last, w, h) {
    const across = niceStep(last - first || 1, Math.max(2, w / 80));
    const step = this.log ? Math.max(1, Math.ceil((high - low) / Math.max(2, h / 26))) : niceStep(high - low, Math.max(2, h / 34));
    Object.assign(pen, { strokeStyle: themeColour("--grid"), lineWidth: 1, fillStyle: themeColour("--faint"), textAlign: "right", textBaseline: "middle" });
    for (const value of ticks(low, high, step)) {
      const y = Math.round(this.y(value)) + 0.5;
      pen.beginPath();
      pen.moveTo(MARGIN.left, y);
      pen.lineTo(w - MARGIN.right, y);
      pen.stroke();
      pen.fillText(this.log ? raise(Math.round(value)) : format(value, step), MARGIN.left - 6, y);
    }
    Object.assign(pen, { textAlign: "center", textBaseline: "bottom" });
    const marks = ticks(first, last, across);
    marks.forEach((t, k) => {
      const words = format(t, across) + (k === marks.length - 1 ? " s" : "");
      pen.fillText(words, Math.min(this.x(t), w - 1 - pen.measureText(words).width / 2), h - 1);
    });
  }

  drawMarks(pen, w) {
    for (const mark of this.marks) {
      const y = this.y(this.log ? Math.log10(mark.value) : mark.value);
      Object.assign(pen, { strokeStyle: themeColour("--cut"), lineWidth: 1 });
      pen.setLineDash([4, 3]);
      pen.beginPath();
      pen.moveTo(MARGIN.left, y);
      pen.lineTo(w - MARGIN.right, y);
      pen.stroke();
      pen.setLineDash([]);
    }
  }

  // Events, as vertical lines with their words.
  drawMoments(pen, w, h) {
    this.moments.forEach(([time, words], k) => {
      const x = Math.round(this.x(time)) + 0.5;
      Object.assign(pen, { strokeStyle: themeColour("--axis"), fillStyle: themeColour("--faint"), lineWidth: 1, textBaseline: "top" });
      pen.beginPath();
      pen.moveTo(x, MARGIN.top);
      pen.lineTo(x, h - MARGIN.bottom);
      pen.stroke();
      // Inside of the chart, and close events in two rows.
      const left = x + pen.measureText(words).width > w - MARGIN.right;
      pen.textAlign = left ? "right" : "left";
      pen.fillText(words, x + (left ? -3 : 3), MARGIN.top + 12 * (k % 2));
    });
  }

  // After the curves, which would cross the names.
  nameMarks(pen, w) {
    for (const mark of this.marks) {
      const y = this.y(this.log ? Math.log10(mark.value) : mark.value);
      Object.assign(pen, { strokeStyle: themeColour("--panel"), fillStyle: themeColour("--cut"), lineWidth: 4, lineJoin: "round", textAlign: "right" });
      const below = mark.below || y < MARGIN.top + 14, at = [mark.name, w - MARGIN.right - 2, y + (below ? 2 : -2)];
      pen.textBaseline = below ? "top" : "bottom";
      pen.strokeText(...at);
      pen.fillText(...at);
    }
  }

  drawLine(pen, line) {
    const style = this.colour(line), name = style.startsWith("var(") ? style.slice(4, -1) : null;
    Object.assign(pen, { strokeStyle: name ? themeColour(name) : style, lineWidth: line.dash ? 1.3 : 1.5, lineJoin: "round" });
    pen.setLineDash(line.dash ? [5, 3] : []);
    pen.beginPath();
    const [start, end] = this.shown();
    for (let k = start, up = true; k < end; k++) {
      const value = line.values[k], [x, y] = [this.x(this.times[k]), this.y(value)];
      if (up || !Number.isFinite(value)) pen.moveTo(x, y);
      else pen.lineTo(x, y);
      up = !Number.isFinite(value);
    }
    pen.stroke();
    pen.setLineDash([]);
  }

  // A number as steps along the bottom, whose largest is a quarter as high as the chart.
  drawStrip(pen, line, h) {
    const [start, end] = this.shown(), base = h - MARGIN.bottom, tall = 0.25 * (base - MARGIN.top);
    const most = line.values.reduce((a, b) => Math.max(a, b || 0), 1);
    pen.beginPath();
    pen.moveTo(this.x(this.times[start]), base);
    for (let k = start; k < end; k++)
      for (const at of [k, k + 1]) pen.lineTo(this.x(this.times[Math.min(at, end - 1)]), base - (tall * (line.values[k] || 0)) / most);
    pen.lineTo(this.x(this.times[end - 1]), base);
    Object.assign(pen, { fillStyle: this.colour(line), globalAlpha: 0.35 });
    pen.fill();
    pen.globalAlpha = 1;
  }

  // Moves the cursor to a time, and shows the values there.
  point(time) {
    this.now = time;
    if (!this.x) return;
    const [low, high] = this.window.span, x = this.x(time);
    this.cursor.hidden = time < low - 1e-9 || time > high + 1e-9;
    this.cursor.style.transform = `translateX(${x.toFixed(1)}px)`;
    const k = Math.max(0, Math.min(this.times.length - 1, upper(this.times, time) - 1));
    // Values far below the axis are rounding errors.
    const most = Math.max(...this.limits.map(Math.abs));
    const words = (value, { floor, none }) => {
      if (none && Number.isNaN(value)) return none;
      if (this.log) return value === -Infinity ? `< ${brief(floor)}` : brief(10 ** value);
      return brief(Math.abs(value) < 1e-9 * most ? 0 : value);
    };
    this.lines.forEach((line, place) => {
      if (this.readouts[place] && !line.mute && this.times.length) this.readouts[place].textContent = words(line.values[k], line);
    });
  }
}
