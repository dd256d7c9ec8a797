// Shared by the replay and live pages: header, view buttons, and the card of an agent.

const $ = (selector) => document.querySelector(selector);

function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

// Text with code between back-ticks.
function prose(words) {
  return words.split("`").map((part, k) => (k % 2 ? make("code", {}, part) : part));
}

const ICONS = { play: "M3 1.5l11 6.5-11 6.5z", pause: "M3 1.5h3.5v13H3zM9.5 1.5H13v13H9.5z" };

function icon(name) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 16 16");
  svg.innerHTML = `<path d="${ICONS[name]}"/>`;
  return svg;
}

function showGuarantee({ state, short, whole }, title = document) {
  const badge = title.querySelector(".promise");
  badge.classList.remove("holds", "edge", "lost", "pending");
  badge.classList.add(state);
  badge.querySelector("b").textContent = short;
  badge.querySelector(".whole").replaceChildren(...prose(whole));
}

// Shows the texts of a run in its part of the page, and its name in an element.
function showHeader(run, part, title) {
  title.querySelector("h1").textContent = run.title;
  title.querySelector(".facts").textContent = run.facts.join(" \u00b7 ");
  part.querySelector(".notes").replaceChildren(...prose(run.notes.join(" ")));
  if (run.promise) showGuarantee(run.promise, title);
  else title.querySelector(".promise").hidden = true;
  const report = title.querySelector(".report");
  report.hidden = !run.report;
  report.addEventListener("click", () => showDialog({ class: "whole-report", "aria-label": "report" }, make("pre", { tabindex: 0 }, run.report)));
  const key = part.querySelector(".key"), add = (look, words) => key.append(make("span", {}, look, words));
  if (run.thrust) add(make("i"), ""), key.lastChild.append("motor thrust 0", make("i", { class: "thrust" }), "limit");
  if (run.agents > run.leaders.length || run.referenced) add(make("i", { class: "ring" }), run.referenced ? "goal, and reference of a leader" : "goal");
  if (run.heard.some((who) => who === 1 || who === 2)) add(make("i", { class: run.agents > 200 ? "taper" : "arrow" }), "from sender to receiver");
  if (run.ellipsoid?.kept) add(make("i", { class: "ellipsoid" }), "ellipsoid: amber below the kept distance, red where two overlap");
  key.append(make("span", {}, run.drawn));
}

// Opens a dialog with a button that closes it.
function showDialog(attributes, content) {
  const dialog = make("dialog", attributes, content), close = make("button", { "aria-label": "close" }, "close");
  close.addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => dialog.remove());
  dialog.append(close);
  document.body.append(dialog);
  dialog.showModal();
}

// Shows which agents were closest to each other so far, beside the size of the vehicles.
function showClosest(element, closest, { ellipsoid }) {
  element.hidden = !closest;
  if (!closest) return;
  const [time, distance, i, j] = closest, touch = ellipsoid && distance < ellipsoid.touching;
  element.classList.toggle("touch", Boolean(touch));
  const scaled = ellipsoid?.kept, size = ellipsoid ? ` (${scaled ? "ellipsoids" : "vehicles"} touch below ${brief(ellipsoid.touching)} m)` : "";
  element.textContent = `${touch ? "overlap: " : ""}smallest ${scaled ? "scaled " : ""}distance in the frames so far ${brief(distance)} m, agents ${i} and ${j} at ${time.toFixed(2)} s${size}`;
}

// Shows the newest event.
function showMoment(part, moment) {
  part.querySelector(".moment").textContent = moment ? `${moment[0].toFixed(2)} s: ${moment[1]}` : "";
}

function setDark(dark) {
  document.documentElement.classList.toggle("dark", dark);
}

// The buttons of one view, or of two beside each other, whose cameras move together.
class ViewControls {
  constructor(views, charts, show) {
    Object.assign(this, { views, show, target: null, box: make("div", { class: "toggles" }) });
    for (const name of ["links", "goals", "trails"]) this.toggle(name, (on) => views.forEach((view) => (view.shared[name].value = on ? opacities(view.run)[name] : 0)));
    if (views.some((view) => view.labels.all.length)) this.toggle("names", (on) => views.forEach((view) => (view.labels.visible = on)));
    const sized = views.flatMap((view) => view.ellipsoids ?? []);
    if (sized.length) this.toggle("ellipsoids", (on) => sized.forEach((each) => (each.shown.value = on ? 1 : 0)), sized[0].shown.value > 0);
    this.makeFollow();
    const home = make("button", { title: "show all (h)" }, "show all");
    home.addEventListener("click", () => this.home());
    this.box.append(home);
    setDark(matchMedia("(prefers-color-scheme: dark)").matches);
    $("#theme").addEventListener("click", () => {
      setDark(!document.documentElement.classList.contains("dark"));
      views.forEach((view) => view.setTheme());
      for (const chart of charts()) chart.draw();
    });
    for (const view of views) {
      view.setTheme();
      view.away.onshow = () => this.home();
      view.onturn = () => views.forEach((other) => other !== view && other.turnLike(view));
      this.handleClicks(view);
    }
  }

  // Keys that both pages have.
  get keys() {
    return {
      n: ["select the next agent", () => this.select(1)],
      p: ["select the previous agent", () => this.select(-1)],
      Escape: ["select none", () => this.select(0)],
      f: ["follow the selected agent with the camera, or stop", () => this.follow(this.target === null && this.views[0].selected >= 0 ? this.views[0].selected : null)],
      h: ["show all", () => this.home()],
    };
  }

  select(step) {
    for (const view of this.views) {
      const { agents } = view.run, first = view.selected < 0 && step < 0 ? 0 : view.selected;
      view.selected = step ? (first + step + agents) % agents : -1;
    }
    this.show();
  }

  home() {
    this.follow(null);
    for (const view of this.views) view.home();
  }

  follow(target) {
    this.target = target;
    this.chooser.value = target ?? "";
    for (const view of this.views) view.moved = null;
    this.show();
  }

  toggle(name, action, begin = true) {
    const button = make("button", { class: "toggle", "aria-pressed": begin }, name);
    button.addEventListener("click", () => {
      const on = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", on);
      action(on);
      for (const view of this.views) view.draw();
    });
    this.box.append(button);
  }

  makeFollow() {
    const run = this.views.map((view) => view.run).reduce((a, b) => (a.agents <= b.agents ? a : b)), leads = new Set(run.leaders);
    this.chooser = make("select", { title: "target of the camera", "aria-label": "target of the camera" });
    const option = (value, words) => this.chooser.append(make("option", { value }, words));
    option("", "fixed camera");
    option("all", "follow all");
    for (const i of run.agents <= 30 ? Array(run.agents).keys() : run.leaders.slice(0, 12)) option(i, leads.has(i) ? `follow leader ${i}` : `follow ${i}`);
    this.chooser.addEventListener("change", () => {
      const { value } = this.chooser;
      this.follow(value === "" ? null : value === "all" ? "all" : Number(value));
    });
    this.box.append(this.chooser);
  }

  // A click selects the agent or link under it; a drag moves the camera.
  handleClicks(view) {
    const canvas = view.renderer.domElement;
    let from = null;
    canvas.addEventListener("pointerdown", (event) => (from = [event.clientX, event.clientY]));
    canvas.addEventListener("pointerup", (event) => {
      if (!from || Math.hypot(event.clientX - from[0], event.clientY - from[1]) > 4) return;
      const box = canvas.getBoundingClientRect(), [x, y] = [event.clientX - box.left, event.clientY - box.top];
      const agent = view.agentAt(x, y), link = agent < 0 ? view.linkAt(x, y) : -1;
      if (link >= 0 && this.onlink) return void this.onlink(link);
      view.selected = agent;
      this.show();
    });
  }

  // Updates the camera and the card of the selected agent.
  update(view, moment) {
    view.follow(moment, this.target);
    const card = view.element.querySelector(".card"), { run, selected } = view;
    card.hidden = selected < 0;
    if (selected < 0) return;
    const leads = run.leaders.includes(selected), p = moment.position, g = moment.goal, at = 3 * selected;
    const away = Math.hypot(...[0, 1, 2].map((k) => (p[at + k] - g[at + k]) / [...run.space.stretch, 1][k]));
    const senders = view.sendersOf(selected), from = leads ? "reference" : "goal";
    const information = senders.length ? `receives from ${senders.slice(0, 8).join(", ")}${senders.length > 8 ? " \u2026" : ""}` : "receives from nobody";
    const place = run.space.kind === "time" ? [p[at + 1] / run.space.stretch[1]] : [0, 1, 2].slice(0, run.space.names.length).map((k) => p[at + k] / [...run.space.stretch, 1][k]);
    const unit = run.space.units[run.space.kind === "time" ? 1 : 0];
    card.replaceChildren(make("b", {}, `${leads ? "leader" : "follower"} ${selected}${run.unlike ? `, ${run.unlike[selected]}` : ""}`), make("span", {}, `at ${place.every(Number.isFinite) ? `${place.map((v) => v.toFixed(2)).join(", ")} ${unit}` : NOT_FINITE}`), make("br"));
    if (!leads || run.referenced) card.append(make("span", {}, Number.isFinite(away) ? `${brief(away)} ${unit} from its ${from}` : `error ${NOT_FINITE}`), make("br"));
    card.append(make("span", {}, information));
  }
}
