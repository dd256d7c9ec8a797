// The bodies of vehicles in one mesh, since software rendering is slow at instances.

// Triangles of one agent: positions, normals and kinds.
class Body {
  constructor() {
    this.position = [];
    this.normal = [];
    this.kind = [];
  }

  triangle(kind, normal, ...corners) {
    for (const corner of corners) {
      this.position.push(...corner);
      this.normal.push(...normal);
      this.kind.push(kind);
    }
  }

  quad(kind, normal, a, b, c, d) {
    this.triangle(kind, normal, a, b, c);
    this.triangle(kind, normal, a, c, d);
  }

  // A flat disc, or a ring with an inner radius.
  disc(kind, [x, y, z], radius, corners, inner = 0, lift = 1) {
    for (let k = 0; k < corners; k++) {
      const [a, b] = [k, k + 1].map((j) => (2 * Math.PI * j) / corners + Math.PI / corners);
      const at = (angle, r) => [x + r * Math.cos(angle), y + r * Math.sin(angle), z];
      if (corners === 4 && !inner && k > 0) continue;
      if (corners === 4 && !inner) this.quad(kind, [0, 0, lift], ...[0, 1, 2, 3].map((j) => at(a + (j * Math.PI) / 2, radius)));
      else if (inner) this.quad(kind, [0, 0, lift], at(a, inner), at(a, radius), at(b, radius), at(b, inner));
      else this.triangle(kind, [0, 0, lift], [x, y, z], at(a, radius), at(b, radius));
    }
  }

  // A box from the middle, half its size, turned about the vertical.
  box(kind, [x, y, z], [u, v, w], angle = 0) {
    const c = Math.cos(angle), s = Math.sin(angle);
    const at = (i, j, k) => [x + c * i * u - s * j * v, y + s * i * u + c * j * v, z + k * w];
    const side = (i, j) => [c * i - s * j, s * i + c * j, 0];
    this.quad(kind, [0, 0, 1], at(-1, -1, 1), at(1, -1, 1), at(1, 1, 1), at(-1, 1, 1));
    this.quad(kind, [0, 0, -1], at(-1, -1, -1), at(-1, 1, -1), at(1, 1, -1), at(1, -1, -1));
    for (const [i, j] of [[1, 0], [0, 1], [-1, 0], [0, -1]]) {
      const [p, q] = i ? [[i, -i], [i, i]] : [[j, j], [-j, j]];
      this.quad(kind, side(i, j), at(...p, -1), at(...q, -1), at(...q, 1), at(...p, 1));
    }
  }

  // A ball of a few rings.
  ball(kind, radius, rings) {
    const at = (i, j) => {
      const up = (Math.PI * i) / rings - Math.PI / 2, round = (Math.PI * j) / rings;
      return [Math.cos(up) * Math.cos(round), Math.cos(up) * Math.sin(round), Math.sin(up)];
    };
    const scaled = (p) => p.map((value) => radius * value);
    for (let i = 0; i < rings; i++)
      for (let j = 0; j < 2 * rings; j++)
        this.quad(kind, at(i + 0.5, j + 0.5), ...[[i, j], [i, j + 1], [i + 1, j + 1], [i + 1, j]].map((p) => scaled(at(...p))));
  }
}

// Front-left, rear-left, rear-right, front-right: the order of the motors.
const MOTORS = [[1, 1], [-1, 1], [-1, -1], [1, -1]];

const SHAPES = {
  quadrotor(body, few) {
    const arm = 0.34, round = few ? 20 : 4;
    MOTORS.forEach(([i, j], k) => {
      const hub = [i * arm, j * arm, 0.05];
      if (few) {
        body.box(8, [i * arm * 0.5, j * arm * 0.5, 0], [0.25, 0.025, 0.022], Math.atan2(j, i));
        body.box(8, [hub[0], hub[1], 0.02], [0.035, 0.035, 0.035]);
        body.disc(k + 1, hub, 0.22, round);
        body.disc(k + 1, hub, 0.235, round, 0.205);
      } else body.disc(k + 1, hub, 0.26, round);
    });
    if (few) {
      body.box(0, [0, 0, 0], [0.12, 0.09, 0.045]);
      body.box(0, [0.15, 0, 0.012], [0.05, 0.035, 0.03]);
    } else body.disc(0, [0, 0, 0.06], 0.2, 4);
  },
  birotor(body, few) {
    body.box(0, [0, 0, 0], [0.14, 0.06, 0.02]);
    body.box(8, [0, 0.03, -0.01], [0.45, 0.02, 0.01]);
    for (const [k, side] of [[1, 1], [2, -1]]) {
      body.box(8, [0.43 * side, 0.06, -0.01], [0.03, 0.05, 0.01]);
      body.box(k, [0.43 * side, 0.125, 0.01], [0.24, 0.022, 0.012]);
      if (few) body.disc(k, [0.43 * side, 0.125, 0.02], 0.05, 12);
    }
  },
  car(body) {
    const top = [0, 0, 1], z = 0.02;
    body.quad(0, top, [-0.4, -0.24, z], [0.12, -0.24, z], [0.12, 0.24, z], [-0.4, 0.24, z]);
    body.triangle(0, top, [0.12, -0.24, z], [0.5, 0, z], [0.12, 0.24, z]);
    for (const side of [1, -1]) body.box(8, [-0.16, 0.3 * side, 0], [0.15, 0.055, 0.01]);
  },
  ball(body, few) {
    body.ball(0, 0.26, few ? 9 : 3);
  },
  dot(body, few) {
    body.disc(0, [0, 0, 0.02], 0.25, few ? 24 : 8);
  },
};

// One geometry with the same body for each agent.
function swarm(shape, agents, space) {
  const body = new Body(), few = agents <= 200, flat = space !== "space";
  SHAPES[shape](body, few);
  if (!flat && few) body.disc(5, [0, 0, 0], shape === "ball" ? 0.26 : 0.4, 20);
  if (few) body.disc(6, [0, 0, flat ? -0.02 : 0], 0.5, 40, 0.455);
  else body.disc(6, [0, 0, flat ? -0.02 : 0], 0.16, 4);
  return repeated(body, agents);
}

// An ellipsoid about each agent, whose radii the shader gives it.
function ellipsoids(agents) {
  const body = new Body();
  body.ball(0, 1, agents > 60 ? 4 : 10);
  return repeated(body, agents);
}

// A ring around the selected agent.
function halo(flat) {
  const body = new Body();
  body.disc(7, [0, 0, flat ? 0.03 : 0], 0.8, 40, 0.72);
  return repeated(body, 1);
}

function repeated(body, agents) {
  const one = body.kind.length, geometry = new THREE.BufferGeometry();
  const fill = (width, source) => {
    const all = new Float32Array(width * one * agents);
    for (let i = 0; i < agents; i++) all.set(typeof source === "function" ? source(i) : source, i * width * one);
    return new THREE.BufferAttribute(all, width);
  };
  geometry.setAttribute("position", fill(3, body.position));
  geometry.setAttribute("normal", fill(3, body.normal));
  geometry.setAttribute("kind", fill(1, body.kind));
  geometry.setAttribute("agent", fill(1, (i) => new Float32Array(one).fill(i)));
  return geometry;
}

const CORNERS = [[0, -1], [1, -1], [1, 1], [0, 1]];

// Four corners per ribbon, with its numbers and indices.
function ribbons(count, numbers) {
  const geometry = new THREE.BufferGeometry(), corner = new Float32Array(8 * count);
  const index = new Uint32Array(6 * count);
  for (let r = 0; r < count; r++) {
    CORNERS.forEach((pair, k) => corner.set(pair, 8 * r + 2 * k));
    index.set([0, 1, 2, 0, 2, 3].map((k) => 4 * r + k), 6 * r);
  }
  geometry.setAttribute("corner", new THREE.BufferAttribute(corner, 2));
  for (const [name, [width, of]] of Object.entries(numbers)) {
    const all = new Float32Array(4 * width * count);
    for (let r = 0; r < count; r++) for (let k = 0; k < 4; k++) all.set(of(r), width * (4 * r + k));
    geometry.setAttribute(name, new THREE.BufferAttribute(all, width));
  }
  geometry.setIndex(new THREE.BufferAttribute(index, 1));
  return geometry;
}
