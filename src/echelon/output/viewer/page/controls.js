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

function showGuarantee({ state, short, whole }) {
  const badge = $(".promise");
  badge.classList.remove("holds", "edge", "lost", "pending");
  badge.classList.add(state);
  badge.querySelector("b").textContent = short;
  badge.querySelector(".whole").replaceChildren(...prose(whole));
}

function showHeader(run) {
  $("h1").textContent = run.title;
  $(".facts").textContent = run.facts.join(" \u00b7 ");
  $(".notes").replaceChildren(...prose(run.notes.join(" ")));
  if (run.promise) showGuarantee(run.promise);
  else $(".promise").hidden = true;
  const key = $(".key"), add = (look, words) => key.append(make("span", {}, look, words));
  if (run.thrust) add(make("i"), ""), key.lastChild.append("motor thrust 0", make("i", { class: "thrust" }), "limit");
  if (run.agents > run.leaders.length) add(make("i", { class: "ring" }), "goal");
  if (run.heard.some((who) => who === 1 || who === 2)) add(make("i", { class: run.agents > 200 ? "taper" : "arrow" }), "from sender to receiver");
  key.append(make("span", {}, run.drawn));
}

function setDark(dark) {
  document.documentElement.classList.toggle("dark", dark);
}

// The buttons of the view.
class ViewControls {
  constructor(view, charts, show) {
    this.view = view;
    this.show = show;
    this.target = null;
    this.box = make("div", { class: "toggles" });
    for (const name of ["links", "goals", "trails"]) this.toggle(name, (on) => (view.shared[name].value = on ? shares(view.run)[name] : 0));
    if (view.labels.all.length) this.toggle("names", (on) => (view.labels.visible = on));
    this.makeFollow();
    const home = make("button", { title: "show all (h)" }, "show all");
    home.addEventListener("click", () => this.home());
    this.box.append(home);
    setDark(matchMedia("(prefers-color-scheme: dark)").matches);
    view.setTheme();
    $("#theme").addEventListener("click", () => {
      setDark(!document.documentElement.classList.contains("dark"));
      view.setTheme();
      for (const chart of charts()) chart.draw();
    });
    this.handleClicks();
  }

  home() {
    this.target = null;
    this.select.value = "";
    this.view.home();
  }

  toggle(name, action) {
    const button = make("button", { class: "toggle", "aria-pressed": "true" }, name);
    button.addEventListener("click", () => {
      const on = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", on);
      action(on);
      this.view.draw();
    });
    this.box.append(button);
  }

  makeFollow() {
    const { run } = this.view, leads = new Set(run.leaders);
    this.select = make("select", { title: "target of the camera", "aria-label": "target of the camera" });
    const option = (value, words) => this.select.append(make("option", { value }, words));
    option("", "fixed camera");
    option("all", "follow all");
    for (const i of run.agents <= 30 ? Array(run.agents).keys() : run.leaders.slice(0, 12)) option(i, leads.has(i) ? `follow leader ${i}` : `follow ${i}`);
    this.select.addEventListener("change", () => {
      const { value } = this.select;
      this.target = value === "" ? null : value === "all" ? "all" : Number(value);
      this.view.moved = null;
      this.show();
    });
    this.box.append(this.select);
  }

  // A click selects the agent or link under it; a drag moves the camera.
  handleClicks() {
    const { view } = this, canvas = view.renderer.domElement;
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
  update(moment) {
    this.view.follow(moment, this.target);
    const card = $(".card"), { run, selected } = this.view;
    card.hidden = selected < 0;
    if (selected < 0) return;
    const leads = run.leaders.includes(selected), p = moment.position, g = moment.goal, at = 3 * selected;
    const away = Math.hypot(...[0, 1, 2].map((k) => (p[at + k] - g[at + k]) / [...run.space.stretch, 1][k]));
    const senders = this.view.sendersOf(selected);
    const information = senders.length ? `receives from ${senders.slice(0, 8).join(", ")}${senders.length > 8 ? " \u2026" : ""}` : "receives from nobody";
    const place = run.space.kind === "time" ? [p[at + 1] / run.space.stretch[1]] : [0, 1, 2].slice(0, run.space.names.length).map((k) => p[at + k] / [...run.space.stretch, 1][k]);
    const unit = run.space.units[run.space.kind === "time" ? 1 : 0];
    card.replaceChildren(make("b", {}, `${leads ? "leader" : "follower"} ${selected}`), make("span", {}, `at ${place.every(Number.isFinite) ? `${place.map((v) => v.toFixed(2)).join(", ")} ${unit}` : NOT_FINITE}`), make("br"));
    if (!leads) card.append(make("span", {}, Number.isFinite(away) ? `${brief(away)} ${unit} from its goal` : `error ${NOT_FINITE}`), make("br"));
    card.append(make("span", {}, information));
  }
}
