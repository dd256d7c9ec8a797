// The scene: vehicles, links, goals and trails, drawn only after a change.

const PALETTE = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"];

// Opacities, lower for large swarms.
function opacities(run) {
  return run.agents > 200 ? { links: 0.3, goals: 1, trails: 0.5 } : { links: 1, goals: 1, trails: 0.95 };
}

class View {
  constructor(element, run) {
    this.element = element;
    this.run = run;
    this.first = new Set(run.leaders);
    this.flat = run.space.kind !== "space";
    this.software = isSoftware();
    this.renderer = new THREE.WebGLRenderer({ antialias: !this.software, alpha: true, powerPreference: "high-performance" });
    this.backdrop = new Backdrop(this);
    element.prepend(this.backdrop.canvas, this.renderer.domElement);
    this.scene = new THREE.Scene();
    this.sharpness = this.targetSharpness = 1;
    this.makeState();
    this.makeUniforms();
    this.makeMeshes();
    this.makeCamera();
    this.labels = new Labels(this);
    this.away = new Away(this);
    this.selected = -1;
    new ResizeObserver(() => this.resize()).observe(element);
    this.setTheme();
    this.resize();
  }

  // ---- geometry ----

  makeState() {
    const { agents } = this.run, rows = Math.ceil(agents / COLUMNS);
    this.state = new Float32Array(4 * TEXELS * COLUMNS * rows);
    this.texture = new THREE.DataTexture(this.state, TEXELS * COLUMNS, rows, THREE.RGBAFormat, THREE.FloatType);
  }

  makeUniforms() {
    const value = (x) => ({ value: x });
    this.shared = {
      state: value(this.texture),
      size: value([1, 1]),
      pixels: value(1.6),
      floor_: value(this.run.box.low[2]),
      links: value(opacities(this.run).links),
      tapered: value(this.run.agents > 200 ? 1 : 0),
      goals: value(1),
      trails: value(opacities(this.run).trails),
      now: value(0),
      window: value(1),
    };
    for (const name of ["shadow", "goalColour", "linkColour", "cutColour", "plain"]) this.shared[name] = value([0, 0, 0]);
  }

  material(code, more = {}) {
    const all = { uniforms: this.shared, glslVersion: THREE.GLSL3, side: THREE.DoubleSide, ...code, ...more };
    return new THREE.ShaderMaterial(all);
  }

  add(geometry, material, order) {
    const mesh = new THREE.Mesh(geometry, material);
    mesh.frustumCulled = false;
    mesh.renderOrder = order;
    this.scene.add(mesh);
    return mesh;
  }

  makeMeshes() {
    const { run } = this, lines = { transparent: true, depthWrite: false };
    this.add(swarm(run.shape, run.agents, run.space.kind), this.material(VEHICLE), 2);
    this.halo = this.add(halo(this.flat), this.material(VEHICLE), 3);
    this.makeLinks(lines);
    this.makeTrails(lines);
    if (run.ellipsoid && run.agents <= 200 && ["space", "plane"].includes(run.space.kind)) this.ellipsoids = new Ellipsoids(this, lines);
    if (run.referenced) this.path = new Path(this, lines);
  }

  makeLinks(lines) {
    this.links = this.add(this.linkGeometry(), this.material(LINK, lines), 1);
    this.cut = this.run.edges.map(() => false);
    this.alive = this.run.edges.map(() => true);
  }

  // Ribbons of all edges, then arrow heads of one-way links, then lines to goals and floor.
  linkGeometry() {
    const { run } = this, few = run.agents <= 60;
    // From sender to receiver; bidirectional links have no direction.
    const ends = run.edges.map(([i, j], edge) => (run.heard[edge] === 2 ? [j, i] : [i, j]));
    const kinds = run.heard.map((receivers) => (receivers === 3 ? 0 : receivers ? 1 : 2));
    this.heads = new Map();
    // Large swarms show the direction by tapered links instead.
    if (run.agents <= 200) run.heard.forEach((receivers, edge) => {
      if (receivers === 1 || receivers === 2) (this.heads.set(edge, ends.length), ends.push(ends[edge]), kinds.push(3));
    });
    if (few) for (let i = 0; i < run.agents; i++) {
      if (run.nearest[i] !== i || run.referenced) (ends.push([i, i]), kinds.push(4));
      if (!this.flat) (ends.push([i, i]), kinds.push(5));
    }
    return ribbons(ends.length, {
      ends: [2, (r) => ends[r]],
      kind: [1, (r) => [kinds[r]]],
      alive: [1, () => [1]],
    });
  }

  // Another law may use other links.
  setReceivers(receivers) {
    this.run.heard = receivers;
    this.links.geometry.dispose();
    this.links.geometry = this.linkGeometry();
    this.run.edges.forEach((_, edge) => this.markLink(edge));
    this.draw();
  }

  makeTrails(lines) {
    this.trail = new Trail(this.run, this.flat);
    this.trailMesh = this.add(this.trail.geometry, this.material(TRAIL, lines), 0);
    this.shared.window.value = this.trail.seconds;
  }

  cutLink(edge, cut) {
    if (this.cut[edge] === cut) return;
    this.cut[edge] = cut;
    this.markLink(edge);
    this.draw();
  }

  // Shows a link as present, cut, or absent in the present graph.
  markLink(edge) {
    const present = !this.row || this.row[edge] === "1", part = this.links.geometry.getAttribute("alive");
    this.alive[edge] = present && !this.cut[edge];
    const shade = this.shades ? 0.6 + 0.4 * this.shades[edge] : 1;
    for (const at of [edge, this.heads.get(edge)])
      if (at !== undefined) part.array.fill(this.cut[edge] ? 0 : present ? shade : -1, 4 * at, 4 * at + 4);
    part.needsUpdate = true;
  }

  // Links fade as their messages age, and flash where one was lost.
  fadeLinks(shades) {
    if (!shades) return;
    this.shades = shades;
    this.run.edges.forEach((_, edge) => this.markLink(edge));
  }

  // Shows the links of a switching graph at a time.
  switchLinks(time) {
    const { schedule, edges } = this.run;
    if (!schedule) return;
    const row = rowAt(schedule, time);
    if (row === this.stretch) return;
    this.stretch = row;
    this.row = schedule.rows[row];
    edges.forEach((_, edge) => this.markLink(edge));
    if (schedule.nearest) this.setLeaders(schedule.nearest[row]);
  }

  // Another agent may lead once the leader is lost.
  setLeaders(nearest) {
    this.run.leaders = [...new Set(nearest)];
    this.setTheme();
    this.labels.rename();
  }

  // The agents from which an agent receives now.
  sendersOf(agent) {
    const { edges, heard } = this.run;
    return edges.flatMap(([i, j], k) => (!this.alive[k] ? [] : j === agent && heard[k] & 1 ? [i] : i === agent && heard[k] & 2 ? [j] : []));
  }

  // ---- camera ----

  makeCamera() {
    const { low, high } = this.run.box;
    this.middle = new THREE.Vector3(...low.map((value, k) => (value + high[k]) / 2));
    this.reach = Math.max(...high.map((value, k) => value - low[k]));
    this.camera = this.flat
      ? new THREE.OrthographicCamera(-1, 1, 1, -1, -1000 * this.reach, 1000 * this.reach)
      : new THREE.PerspectiveCamera(32, 1, this.reach / 500, this.reach * 60);
    this.camera.up.set(0, this.flat ? 1 : 0, this.flat ? 0 : 1);
    this.orbit = new THREE.OrbitControls(this.camera, this.renderer.domElement);
    Object.assign(this.orbit, { enableRotate: !this.flat, screenSpacePanning: this.flat, zoomToCursor: this.flat });
    if (this.flat) this.orbit.mouseButtons = { LEFT: 2, MIDDLE: 1, RIGHT: 2 };
    if (this.flat) this.orbit.touches = { ONE: 1, TWO: 2 };
    this.orbit.maxPolarAngle = 0.495 * Math.PI;
    this.orbit.addEventListener("change", () => (this.draw(), this.onturn?.()));
    this.home();
  }

  // The box of the run, extended to all agents.
  everything() {
    const { low, high } = this.run.box, p = this.moment?.position ?? [];
    const ends = [[...low], [...high]];
    for (let at = 0; at < p.length; at++) {
      if (!Number.isFinite(p[at])) continue;
      ends[0][at % 3] = Math.min(ends[0][at % 3], p[at]);
      ends[1][at % 3] = Math.max(ends[1][at % 3], p[at]);
    }
    return ends;
  }

  // Look at everything.
  home() {
    const [low, high] = this.everything(), [w, h] = [this.element.clientWidth || 16, this.element.clientHeight || 9];
    const middle = new THREE.Vector3(...low.map((value, k) => (value + high[k]) / 2));
    const reach = Math.max(...high.map((value, k) => value - low[k]));
    if (!this.flat) Object.assign(this.camera, { near: reach / 500, far: reach * 60 });
    this.camera.updateProjectionMatrix();
    this.orbit.target.copy(middle);
    this.moved = null;
    if (this.flat) {
      this.camera.position.set(middle.x, middle.y, 10);
      this.camera.zoom = 0.86 * Math.min(w / (high[0] - low[0]), h / (high[1] - low[1]));
      this.camera.updateProjectionMatrix();
    } else {
      this.fit(w / h, low, high, middle);
    }
    this.orbit.update();
    this.draw();
  }

  // Places the camera so that the box just fits, centered in the picture.
  fit(aspect, low, top, center) {
    const back = new THREE.Vector3(0.42, -0.78, 0.47).normalize(), up = new THREE.Vector3(0, 0, 1);
    const right = up.clone().cross(back).normalize(), high = back.clone().cross(right);
    const tall = Math.tan((this.camera.fov * Math.PI) / 360) * 0.87, wide = tall * aspect;
    const corners = [];
    for (let k = 0; k < 8; k++) corners.push(new THREE.Vector3(...[0, 1, 2].map((axis) => ((k >> axis) & 1 ? top : low)[axis])).sub(center));
    let [x, y, away] = [0, 0, 0];
    // The middle of the picture depends on the distance.
    for (let round = 0; round < 8; round++) {
      away = Math.max(...corners.map((c) => Math.max(Math.abs(c.dot(right) - x) / wide, Math.abs(c.dot(high) - y) / tall) + c.dot(back)));
      const view = (axis) => corners.map((c) => c.dot(axis) / (away - c.dot(back)));
      const middle = (values) => (Math.max(...values) + Math.min(...values)) / 2;
      [x, y] = [away * middle(view(right)), away * middle(view(high))];
    }
    this.orbit.target.add(right.multiplyScalar(x)).add(high.multiplyScalar(y));
    this.camera.position.copy(this.orbit.target).add(back.multiplyScalar(away));
  }

  // Takes the camera of another view; not between a plane and space.
  turnLike(view) {
    const [from, to] = [view.camera, this.camera];
    if (this.flat !== view.flat || (to.position.equals(from.position) && to.zoom === from.zoom)) return;
    to.position.copy(from.position);
    this.orbit.target.copy(view.orbit.target);
    to.zoom = from.zoom;
    to.updateProjectionMatrix();
    this.orbit.update();
  }

  // Keeps an agent, or the mean of all, at its place on the screen; null stops.
  follow(moment, target) {
    if (target === null) return void (this.moved = null);
    const p = moment.position, at = new THREE.Vector3();
    const { agents } = this.run, chosen = target === "all" ? [...Array(agents).keys()] : [target];
    for (const i of chosen) at.add(new THREE.Vector3(p[3 * i], p[3 * i + 1], p[3 * i + 2]));
    at.divideScalar(chosen.length);
    const shift = at.clone().sub(this.moved ?? this.orbit.target);
    this.camera.position.add(shift);
    this.orbit.target.add(shift);
    this.moved = at;
    this.orbit.update();
  }

  resize() {
    const [w, h] = [this.element.clientWidth, this.element.clientHeight];
    if (!w || !h) return;
    if (this.flat) {
      const old = this.camera.right * 2 || w;
      Object.assign(this.camera, { left: -w / 2, right: w / 2, top: h / 2, bottom: -h / 2 });
      if (old === 2) this.home();
    } else this.camera.aspect = w / h;
    this.camera.updateProjectionMatrix();
    this.backdrop.resize(w, h);
    this.setSharpness(this.targetSharpness = 1);
    if (!this.hasSize) this.home();
    this.hasSize = true;
    this.draw();
  }

  setSharpness(sharpness) {
    const ratio = sharpness * (this.software ? 1 : Math.min(2, devicePixelRatio));
    const [w, h] = [this.element.clientWidth, this.element.clientHeight];
    this.sharpness = sharpness;
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(w, h);
    this.shared.size.value = [w, h];
  }

  // ---- drawing ----

  setTheme() {
    const uniforms = { shadow: "--shade", goalColour: "--goal", linkColour: "--link", cutColour: "--cut", plain: "--plain" };
    for (const [name, colour] of Object.entries(uniforms)) this.shared[name].value = rgb(themeColour(colour));
    const { run, state } = this, leader = rgb(themeColour("--leader"));
    const leads = new Set(run.leaders), many = run.agents > 200;
    let place = 0;
    for (let i = 0; i < run.agents; i++) {
      const colour = leads.has(i) ? leader : rgb(PALETTE[many ? 0 : place % PALETTE.length]);
      place += this.first.has(i) ? 0 : 1;
      state.set([...colour, run.size * (many && leads.has(i) ? 1.25 : 1)], 4 * this.texel(i, 3));
    }
    this.draw();
  }

  texel(agent, k) {
    return Math.floor(agent / COLUMNS) * COLUMNS * TEXELS + (agent % COLUMNS) * TEXELS + k;
  }

  show(moment) {
    const { state, run } = this, { position: p, turn: q, motors: m, goal: g } = moment, near = this.ellipsoids?.marks(p);
    for (let i = 0; i < run.agents; i++) {
      let at = 4 * this.texel(i, 0);
      const exists = Number.isFinite(p[3 * i] + p[3 * i + 1] + p[3 * i + 2]);
      for (let k = 0; k < 3; k++) state[at + k] = exists ? p[3 * i + k] : 0;
      state[at + 3] = !exists ? -1 : (near?.[i] ?? 0) + (i === this.selected ? 1 : 0);
      for (let k = 0; k < 4; k++) (state[at + 4 + k] = q[4 * i + k]), (state[at + 8 + k] = m[4 * i + k]);
      at += 16;
      state[at] = g[3 * i], state[at + 1] = g[3 * i + 1], state[at + 2] = g[3 * i + 2];
      state[at + 3] = (run.nearest[i] === i && !run.referenced) || !Number.isFinite(g[3 * i]) ? 0 : 1;
    }
    this.texture.needsUpdate = true;
    this.halo.visible = this.selected >= 0;
    if (this.halo.visible) {
      const agent = this.halo.geometry.getAttribute("agent");
      agent.array.fill(this.selected);
      agent.needsUpdate = true;
    }
    this.switchLinks(moment.time);
    this.fadeLinks(moment.shades);
    this.shared.now.value = moment.time;
    this.trail.window(this.trailMesh.geometry, moment.time);
    this.moment = moment;
    this.draw();
  }

  draw() {
    if (this.scheduled) return;
    this.scheduled = true;
    requestAnimationFrame(() => this.render());
  }

  render() {
    const start = performance.now();
    this.scheduled = false;
    if (this.targetSharpness !== this.sharpness) this.setSharpness(this.targetSharpness);
    this.backdrop.draw();
    this.renderer.render(this.scene, this.camera);
    this.labels.place();
    this.away.count(start);
    this.adapt(performance.now() - start, start);
  }

  // Fewer pixels while drawing is too slow, all pixels again when nothing moves.
  adapt(duration, now) {
    const between = now - (this.last ?? 0);
    this.last = now;
    clearTimeout(this.rest);
    const busy = between < 400 && Math.max(between, duration) > 45;
    this.slow = busy ? (this.slow ?? 0) + 1 : 0;
    if (this.slow > 3 && this.sharpness > 0.5) (this.targetSharpness = Math.max(0.5, 0.8 * this.sharpness)), (this.slow = 0);
    if (this.targetSharpness < 1) this.rest = setTimeout(() => ((this.targetSharpness = 1), this.draw()), 400);
  }

  // The pixel of a place in the scene; null behind the camera, and where the place is no number.
  project(x, y, z) {
    const v = new THREE.Vector3(x, y, z).project(this.camera);
    if ((v.z > 1 && !this.flat) || !Number.isFinite(v.x + v.y)) return null;
    return [(0.5 + 0.5 * v.x) * this.element.clientWidth, (0.5 - 0.5 * v.y) * this.element.clientHeight];
  }

  projectAgent(i) {
    const p = this.moment.position;
    return this.project(p[3 * i], p[3 * i + 1], p[3 * i + 2]);
  }

  // The agent closest to a pixel, or -1.
  agentAt(x, y) {
    let closest = -1, least = 24;
    for (let i = 0; i < this.run.agents; i++) {
      const at = this.projectAgent(i);
      const away = at ? Math.hypot(at[0] - x, at[1] - y) : Infinity;
      if (away < least) (closest = i), (least = away);
    }
    return closest;
  }

  // The link closest to a pixel, or -1.
  linkAt(x, y) {
    let closest = -1, least = 9;
    this.run.edges.forEach(([i, j], edge) => {
      if (!this.alive[edge] && !this.cut[edge]) return;
      const [a, b] = [this.projectAgent(i), this.projectAgent(j)];
      if (!a || !b) return;
      const [u, v] = [b[0] - a[0], b[1] - a[1]], length = u * u + v * v || 1;
      const t = Math.max(0, Math.min(1, ((x - a[0]) * u + (y - a[1]) * v) / length));
      const away = Math.hypot(a[0] + t * u - x, a[1] + t * v - y);
      if (away < least) (closest = edge), (least = away);
    });
    return closest;
  }
}
