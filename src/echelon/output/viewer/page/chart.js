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

class Chart {
  // The chart has title, unit, log, lines and marks; `seek` is called with a selected time.
  constructor(element, chart, seek) {
    Object.assign(this, chart);
    this.element = document.createElement("figure");
    this.element.className = "chart";
    this.element.innerHTML = `<figcaption><b></b><span class="legend"></span></figcaption>
      <div class="area"><canvas></canvas><div class="cursor"></div></div>`;
    this.element.querySelector("b").textContent = this.unit ? `${this.title}, ${this.unit}` : this.title;
    element.append(this.element);
    this.canvas = this.element.querySelector("canvas");
    this.cursor = this.element.querySelector(".cursor");
    this.area = this.element.querySelector(".area");
    this.makeLegend();
    if (seek) this.listen(seek);
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

  listen(seek) {
    const choose = (event) => {
      const box = this.area.getBoundingClientRect();
      const part = (event.clientX - box.left - MARGIN.left) / (box.width - MARGIN.left - MARGIN.right);
      const [low, high] = this.span();
      seek(low + Math.max(0, Math.min(1, part)) * (high - low));
    };
    this.area.addEventListener("pointerdown", (event) => {
      this.area.setPointerCapture(event.pointerId);
      choose(event);
    });
    this.area.addEventListener("pointermove", (event) => event.buttons && choose(event));
  }

  span() {
    const { times } = this;
    return times.length > 1 ? [times[0], times[times.length - 1]] : [0, 1];
  }

  // The limits of the value axis; of a logarithmic one as exponents.
  reach() {
    let [low, high] = [Infinity, -Infinity];
    const take = (y) => Number.isFinite(y) && ((low = Math.min(low, y)), (high = Math.max(high, y)));
    for (const line of this.lines) if (!line.bound) line.values.forEach(take);
    for (const mark of this.marks) take(this.log ? Math.log10(mark.value) : mark.value);
    if (!(low <= high)) return this.log ? [-1, 0] : [0, 1];
    if (this.log) return high - low > 2 ? [low - 0.15, high + 0.25] : [Math.floor(low - 0.05), Math.ceil(high + 0.05)];
    const margin = 0.06 * (high - low) || Math.max(1e-6, 0.1 * Math.abs(high));
    return [low - margin, high + margin];
  }

  draw() {
    const [w, h] = [this.area.clientWidth, this.area.clientHeight], ratio = Math.min(2, devicePixelRatio);
    if (!w || !h) return;
    Object.assign(this.canvas, { width: Math.round(w * ratio), height: Math.round(h * ratio) });
    const pen = this.canvas.getContext("2d"), [low, high] = this.reach(), [first, last] = this.span();
    pen.scale(ratio, ratio);
    pen.font = "11px system-ui, sans-serif";
    this.x = (t) => MARGIN.left + ((t - first) / (last - first || 1)) * (w - MARGIN.left - MARGIN.right);
    this.y = (v) => h - MARGIN.bottom - ((v - low) / (high - low)) * (h - MARGIN.top - MARGIN.bottom);
    this.drawGrid(pen, low, high, first, last, w, h);
    pen.save();
    pen.beginPath();
    pen.rect(MARGIN.left, MARGIN.top - 2, w - MARGIN.left - MARGIN.right, h - MARGIN.top - MARGIN.bottom + 4);
    pen.clip();
    this.drawMarks(pen, w);
    for (const line of this.lines) this.drawLine(pen, line);
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

  // After the curves, which would cross the names.
  nameMarks(pen, w) {
    for (const mark of this.marks) {
      const y = this.y(this.log ? Math.log10(mark.value) : mark.value);
      Object.assign(pen, { strokeStyle: themeColour("--panel"), fillStyle: themeColour("--cut"), lineWidth: 4, lineJoin: "round", textAlign: "right", textBaseline: mark.below ? "top" : "bottom" });
      const at = [mark.name, w - MARGIN.right - 2, y + (mark.below ? 2 : -2)];
      pen.strokeText(...at);
      pen.fillText(...at);
    }
  }

  drawLine(pen, line) {
    const style = this.colour(line), name = style.startsWith("var(") ? style.slice(4, -1) : null;
    Object.assign(pen, { strokeStyle: name ? themeColour(name) : style, lineWidth: line.dash ? 1.3 : 1.5, lineJoin: "round" });
    pen.setLineDash(line.dash ? [5, 3] : []);
    pen.beginPath();
    let up = true;
    line.values.forEach((value, k) => {
      if (!Number.isFinite(value)) return void (up = true);
      const at = [this.x(this.times[k]), this.y(value)];
      if (up) pen.moveTo(...at);
      pen.lineTo(...at);
      up = false;
    });
    pen.stroke();
    pen.setLineDash([]);
  }

  // Moves the cursor to a time, and shows the values there.
  point(time) {
    this.now = time;
    if (!this.x) return;
    this.cursor.style.transform = `translateX(${this.x(time).toFixed(1)}px)`;
    const k = Math.max(0, Math.min(this.times.length - 1, upper(this.times, time) - 1));
    // Values far below the axis are rounding errors.
    const most = Math.max(...this.reach().map(Math.abs));
    const words = (value, floor) => {
      if (this.log) return value === -Infinity ? `< ${brief(floor)}` : brief(10 ** value);
      return brief(Math.abs(value) < 1e-9 * most ? 0 : value);
    };
    this.lines.forEach((line, place) => {
      if (this.readouts[place] && !line.mute && this.times.length) this.readouts[place].textContent = words(line.values[k], line.floor);
    });
  }
}
