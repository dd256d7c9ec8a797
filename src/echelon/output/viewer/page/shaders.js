// Shaders. The state of all agents is one texture with five texels per agent:
// 0 place and mark (1 selected, and 2 nearer to another than hulls keep or 4 overlapping; -1 without a finite place), 1 attitude, 2 motors, 3 colour and size, 4 goal and its visibility.

const COLUMNS = 64, TEXELS = 5;

const FETCH = `
uniform highp sampler2D state;
vec4 texel(float agent, int k) {
  int i = int(agent + 0.5);
  return texelFetch(state, ivec2((i % ${COLUMNS}) * ${TEXELS} + k, i / ${COLUMNS}), 0);
}`;

// Greys, which no agent has, and a red towards the limit; darker with thrust for colour-blind readers.
const THRUST = `
vec3 thrust(float s) {
  vec3 a = vec3(0.78, 0.81, 0.86), b = vec3(0.46, 0.50, 0.57), c = vec3(0.74, 0.08, 0.20);
  s = clamp(s, 0.0, 1.0);
  return s < 0.7 ? mix(a, b, s / 0.7) : mix(b, c, (s - 0.7) / 0.3);
}`;

// Whether graphics are rendered in software.
function isSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) throw new Error("this browser has no WebGL 2");
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}

function rgb(colour) {
  const c = new THREE.Color(colour);
  c.convertLinearToSRGB();
  return [c.r, c.g, c.b];
}

function themeColour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

// kind: 0 body, 1 to 4 a rotor, 5 shadow, 6 ring of the goal, 7 ring of selection, 8 dark part.
const VEHICLE = {
  vertexShader: `${FETCH}${THRUST}
in float agent, kind;
out vec3 shade;
uniform float floor_, goals;
uniform vec3 shadow, goalColour, plain;
vec3 turned(vec4 q, vec3 v) { return v + 2.0 * cross(q.xyz, cross(q.xyz, v) + q.w * v); }
void main() {
  vec4 place = texel(agent, 0), q = texel(agent, 1), motors = texel(agent, 2), look = texel(agent, 3), goal = texel(agent, 4);
  vec3 p = position * look.w, n = normal;
  shade = look.rgb;
  if (kind < 4.5 || kind > 7.5) {
    p = place.xyz + turned(q, p);
    n = turned(q, n);
    float light = 0.62 + 0.38 * clamp(dot(n, normalize(vec3(0.3, -0.5, 0.85))), -0.6, 1.0);
    if (kind > 0.5 && kind < 4.5) {
      float s = motors[int(kind - 0.5)];
      shade = s < 0.0 ? mix(look.rgb, plain, 0.55) : thrust(s);
      light = 0.9 + 0.1 * n.z;
    }
    if (kind > 7.5) shade *= 0.55;
    shade *= light;
    if (mod(place.w, 2.0) > 0.5) shade = mix(shade, vec3(1.0), 0.18);
  } else if (kind < 5.5) {
    p = vec3(place.xy + p.xy, floor_);
    shade = shadow;
  } else if (kind < 6.5) {
    p = goal.xyz + p * goals * goal.w;
    shade = goalColour;
  } else {
    p = place.xyz + p;
  }
  gl_Position = place.w < -0.5 ? vec4(2.0, 2.0, 2.0, 1.0) : projectionMatrix * modelViewMatrix * vec4(p, 1.0);
}`,
  fragmentShader: `in vec3 shade; out vec4 colour; void main() { colour = vec4(shade, 1.0); }`,
};

// The space about an agent: seen at its edge, and amber or red where another is too near.
const ELLIPSOID = {
  vertexShader: `${FETCH}
in float agent;
out vec4 shade;
uniform vec3 radii, cutColour, goalColour;
uniform float ellipsoids;
void main() {
  vec4 place = texel(agent, 0), eye = modelViewMatrix * vec4(place.xyz + position * radii, 1.0);
  vec3 look = projectionMatrix[3][3] > 0.5 ? vec3(0.0, 0.0, 1.0) : -normalize(eye.xyz);
  float edge = 1.0 - abs(dot(normalize(normalMatrix * (position / radii)), look));
  vec3 colour = place.w > 3.5 ? cutColour : place.w > 1.5 ? goalColour : texel(agent, 3).rgb;
  shade = vec4(colour, (place.w > 1.5 ? 0.3 : 0.06) + 0.4 * edge * edge);
  bool hidden = place.w < -0.5 || (ellipsoids < 0.5 && place.w < 1.5);
  gl_Position = hidden ? vec4(2.0, 2.0, 2.0, 1.0) : projectionMatrix * eye;
}`,
  fragmentShader: `in vec4 shade; out vec4 colour; void main() { colour = shade; }`,
};

// A line of a width in pixels between two points: four corners, moved on the screen.
const RIBBON = `
uniform vec2 size;
uniform float pixels;
vec4 ribbon(vec3 first, vec3 second, vec2 corner, float wide) {
  vec4 a = projectionMatrix * modelViewMatrix * vec4(first, 1.0);
  vec4 b = projectionMatrix * modelViewMatrix * vec4(second, 1.0);
  const float near = 0.01;
  if (a.w < near && b.w > near) a = mix(a, b, (near - a.w) / (b.w - a.w));
  if (b.w < near && a.w > near) b = mix(b, a, (near - b.w) / (a.w - b.w));
  vec2 way = (b.xy / b.w - a.xy / a.w) * size;
  way = length(way) > 1e-6 ? normalize(way) : vec2(1.0, 0.0);
  vec4 end = corner.x < 0.5 ? a : b;
  end.xy += vec2(-way.y, way.x) * corner.y * wide * pixels / size * end.w;
  return end;
}`;

// An arrow head towards an agent, whose tip ends at the body: a triangle in pixels.
const HEAD = `
vec4 head(vec3 first, vec3 second, vec2 corner, float body) {
  vec4 a = projectionMatrix * modelViewMatrix * vec4(first, 1.0);
  vec4 b = projectionMatrix * modelViewMatrix * vec4(second, 1.0);
  if (a.w < 0.01 || b.w < 0.01) return vec4(2.0, 2.0, 2.0, 1.0);
  vec3 from = a.xyz / a.w, to = b.xyz / b.w;
  vec2 way = (to.xy - from.xy) * size * 0.5;
  float whole = length(way), tall = min(14.0, 0.4 * whole);
  if (whole < 4.0) return vec4(2.0, 2.0, 2.0, 1.0);
  float gap = min(body * projectionMatrix[1][1] * size.y * 0.5 / b.w, 0.5 * whole);
  float back = gap + (corner.x < 0.5 ? tall : 0.0);
  vec3 at = mix(to, from, back / whole);
  vec2 aside = vec2(-way.y, way.x) / whole * (corner.x < 0.5 ? 0.4 * tall * corner.y : 0.0);
  return vec4(at.xy + aside / (size * 0.5), at.z, 1.0);
}`;

// kind of a link: 0 bidirectional, 1 from the first to the second, 2 inactive; 3 an arrow head,
// 4 to the goal of an agent, 5 down to the floor. alive: from 0.6 for an old message to 1 for a new one, 1.4 for a lost
// one, 0 cut, -1 absent.
const LINK = {
  vertexShader: `${FETCH}${RIBBON}${HEAD}
in vec2 ends, corner;
in float kind, alive;
out vec4 shade;
out float along;
uniform float floor_, links, goals, tapered;
uniform vec3 linkColour, cutColour, goalColour, shadow;
void main() {
  vec3 first = texel(ends.x, 0).xyz, second = texel(ends.y, 0).xyz;
  float wide = kind > 0.5 && kind < 1.5 ? mix(1.1, 2.6 - 2.2 * corner.x, tapered) : 1.1;
  bool cut = alive < 0.5;
  shade = vec4(cut ? cutColour : linkColour, links * (cut ? 0.55 : kind > 1.5 && kind < 2.5 ? 0.4 : 0.9));
  if (kind < 3.5 && alive > 0.5) {
    if (alive > 1.2) shade.rgb = cutColour;
    else shade.a *= clamp(2.5 * alive - 1.5, 0.12, 1.0);
  }
  if (alive < -0.5 || (cut && kind > 2.5 && kind < 3.5)) shade.a = 0.0;
  along = cut ? corner.x : -1.0;
  if (kind > 3.5) {
    vec4 goal = texel(ends.x, 4);
    second = kind < 4.5 ? goal.xyz : vec3(first.xy, floor_);
    wide = kind < 4.5 ? 0.9 : 0.55;
    shade = kind < 4.5 ? vec4(goalColour, 0.75 * goals * goal.w) : vec4(shadow, 1.0);
  }
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  if (shade.a <= 0.0 || min(texel(ends.x, 0).w, texel(ends.y, 0).w) < -0.5) return;
  if (kind > 2.5 && kind < 3.5) gl_Position = head(first, second, corner, 0.62 * texel(ends.y, 3).w);
  else gl_Position = ribbon(first, second, corner, wide);
}`,
  fragmentShader: `in vec4 shade; in float along; out vec4 colour;
void main() { if (along > 0.0 && fract(along * 14.0) > 0.5) discard; colour = shade; }`,
};

// The path that a leader should follow, dashed.
const PATH = {
  vertexShader: `${RIBBON}
in vec3 first, second;
in float along;
in vec2 corner;
out float place;
uniform float goals;
void main() {
  place = along;
  gl_Position = goals > 0.0 ? ribbon(first, second, corner, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
}`,
  fragmentShader: `in float place; out vec4 colour; uniform vec3 goalColour;
void main() { if (mod(place, 2.0) > 0.5) discard; colour = vec4(goalColour, 0.55); }`,
};

// The path of an agent, paler with age.
const TRAIL = {
  vertexShader: `${FETCH}${RIBBON}
in vec3 first, second;
in float agent, when;
in vec2 corner;
out vec4 shade;
uniform float now, window, trails;
void main() {
  float age = (now - when) / window;
  shade = vec4(texel(agent, 3).rgb, trails * (1.0 - 0.85 * age));
  bool visible = trails > 0.0 && age >= 0.0 && age <= 1.0;
  gl_Position = visible ? ribbon(first, second, corner, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
}`,
  fragmentShader: `in vec4 shade; out vec4 colour; void main() { colour = shade; }`,
};
