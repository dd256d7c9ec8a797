// A run in the page: packed 16-bit numbers, and the state at any time.

// The bytes of a zlib stream in base64.
async function inflate(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// A group of channels: differences in time, channel by channel, low bytes before high ones.
function readGroup(raw, start, group) {
  const { frames } = group, channels = group.low.length, size = channels * frames;
  const wide = group.bytes === 2, values = new Uint16Array(size);
  for (let c = 0, at = 0; c < channels; c++) {
    let sum = 0;
    for (let k = 0; k < frames; k++, at++) {
      sum += raw[start + at] + (wide ? raw[start + size + at] << 8 : 0);
      values[at] = sum &= wide ? 0xffff : 0xff;
    }
  }
  return { ...group, values, end: start + size * group.bytes };
}

// Codes of no finite number, and of one below the axis.
const GAP = 65535, BELOW = 65534;

// The value of channel c between frames k and k + 1.
function valueOf(group, c, k, part) {
  const at = c * group.frames + k, first = group.values[at], second = part > 0 ? group.values[at + 1] : first;
  if (group.gaps && (first >= BELOW || second >= BELOW)) return first === second && first === BELOW ? -Infinity : NaN;
  return group.low[c] + group.step[c] * (first + part * (second - first));
}

// The state at one time, filled by a replay or a stream and drawn by the scene.
class Moment {
  constructor(agents) {
    this.time = 0;
    this.position = new Float32Array(3 * agents);
    this.turn = new Float32Array(4 * agents).fill(0);
    this.motors = new Float32Array(4 * agents).fill(-1);
    this.goal = new Float32Array(3 * agents);
    this.reference = new Float32Array(3);
    for (let i = 0; i < agents; i++) this.turn[4 * i + 3] = 1;
  }

  // Angles about x, y and z, the last one applied first (ZYX), as a quaternion.
  setAngles(i, roll, pitch, yaw) {
    const cr = Math.cos(roll / 2), cp = Math.cos(pitch / 2), cy = Math.cos(yaw / 2);
    const sr = Math.sin(roll / 2), sp = Math.sin(pitch / 2), sy = Math.sin(yaw / 2);
    const q = this.turn, at = 4 * i;
    q[at] = sr * cp * cy - cr * sp * sy;
    q[at + 1] = cr * sp * cy + sr * cp * sy;
    q[at + 2] = cr * cp * sy - sr * sp * cy;
    q[at + 3] = cr * cp * cy + sr * sp * sy;
  }

  // The goal of a follower is its offset from its nearest leader, that of a leader from the reference.
  setGoals(run) {
    const { position: p, goal, reference } = this, { offsets, schedule } = run;
    const nearest = schedule?.nearest?.[rowAt(schedule, this.time)] ?? run.nearest;
    for (let i = 0; i < run.agents; i++)
      for (let k = 0, to = nearest[i]; k < 3; k++)
        goal[3 * i + k] = to === i && run.referenced ? reference[k] + offsets[3 * i + k] : p[3 * to + k] + offsets[3 * i + k] - offsets[3 * to + k];
    if (run.space.kind === "time") for (let i = 0; i < run.agents; i++) goal[3 * i] = p[3 * i];
  }
}

// Which row of a schedule holds at a time.
function rowAt({ starts, period }, time) {
  return Math.max(0, upper(starts, (period ? (time + 1e-9) % period : time + 1e-9)) - 1);
}

class Replay {
  constructor(header, raw) {
    Object.assign(this, header);
    this.offsets = expand(header.offsets, header.agents, header.space);
    let at = 0;
    for (const [name, group] of Object.entries(header.groups)) {
      const read = readGroup(raw, at, group);
      at = read.end;
      this[name] = read;
    }
    this.moment = new Moment(this.agents);
    if (this.reference) this.path = this.referencePlaces();
  }

  // Places along the reference, at most 400.
  referencePlaces() {
    const every = Math.ceil(this.frames / 400), place = new Float32Array(3);
    return Array.from({ length: Math.ceil(this.frames / every) }, (_, k) => {
      this.fill(place, this.reference, k * every, 0, this.timeOf(k * every));
      return [...place];
    });
  }

  timeOf(frame) {
    const { start, step, last } = this.clock;
    return frame >= this.frames - 1 ? last : start + step * frame;
  }

  frameOf(time) {
    const { start, step, last } = this.clock;
    if (time >= last) return this.frames - 1;
    const k = Math.max(0, Math.min(this.frames - 2, Math.floor((time - start) / step)));
    return k + Math.max(0, Math.min(1, (time - this.timeOf(k)) / (this.timeOf(k + 1) - this.timeOf(k))));
  }

  // Fills and returns the state at a frame, which may be fractional.
  at(frame) {
    const now = this.moment, k = Math.min(Math.floor(frame), this.frames - 1), part = frame - k;
    now.time = this.timeOf(k) + (part > 0 ? part * (this.timeOf(k + 1) - this.timeOf(k)) : 0);
    this.fill(now.position, this.positions, k, part, now.time);
    if (this.reference) this.fill(now.reference, this.reference, k, part, now.time);
    if (this.angles) this.fillTurns(now, k, part);
    if (this.motors)
      for (let c = 0, wide = this.motors.low.length / this.agents; c < this.motors.low.length; c++)
        now.motors[4 * Math.floor(c / wide) + (c % wide)] = valueOf(this.motors, c, k, part);
    if (this.shades) now.shades = this.shades.low.map((_, edge) => valueOf(this.shades, edge, k, 0));
    if (this.moving) this.fill(this.offsets, this.moving, k, part, now.time);
    now.setGoals(this);
    return now;
  }

  // Fills places in the scene from a group of coordinates.
  fill(out, group, k, part, time) {
    const agents = out.length / 3, axes = group.low.length / agents, [sx, sy] = this.space.stretch;
    for (let i = 0; i < agents; i++) {
      const value = (axis) => valueOf(group, axes * i + axis, k, part);
      if (this.space.kind === "time") {
        out[3 * i] = sx * time;
        out[3 * i + 1] = sy * value(0);
      } else {
        out[3 * i] = sx * value(0);
        out[3 * i + 1] = sy * value(1);
        out[3 * i + 2] = axes > 2 ? value(2) : 0;
      }
    }
  }

  fillTurns(now, k, part) {
    const wide = this.angles.low.length / this.agents;
    for (let i = 0; i < this.agents; i++) {
      const angle = (axis) => valueOf(this.angles, wide * i + axis, k, part);
      if (wide === 3) now.setAngles(i, angle(0), angle(1), angle(2));
      else now.setAngles(i, 0, 0, angle(0));
    }
  }
}

// Offsets by agent and axis as three numbers in the scene.
function expand(rows, agents, space) {
  const out = new Float32Array(3 * agents), [sx, sy] = space.stretch;
  rows.forEach((row, i) => {
    if (space.kind === "time") out[3 * i + 1] = sy * row[0];
    else row.forEach((value, k) => (out[3 * i + k] = value * [sx, sy, 1][k]));
  });
  return out;
}
