"use strict";
// A view in space on a canvas: points by a depth buffer, lines, circles and arrows over them. Right-handed, z up, mm.
// Parts can be switched off: each has lines, points with a value, and marks of its own (balls, defects). Joints have a
// section and gaps at its points. Regions of points have an outline, each a part of its own. Coordinates drawn are
// relative to `origin`, which is added to those shown as text.
function make(tag, attributes, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes || {})) {
    if (key in element) element[key] = value; else element.setAttribute(key, value);
  }
  element.append(...children); // strings become text: names from files are never read as markup
  return element;
}

let words = {}; // texts in the page's language; others stay as they are
function say(text) { return words[text] || text; }

function millimetres(value) { return value === null ? "–" : value.toFixed(3); }

function colourTable(stops, size) {
  const rgb = stops.map((stop) => [1, 3, 5].map((at) => parseInt(stop.slice(at, at + 2), 16)));
  return Array.from({ length: size }, (_, i) => {
    const at = (i / (size - 1)) * (rgb.length - 1), low = Math.min(Math.floor(at), rgb.length - 2);
    return rgb[low].map((value, k) => Math.round(value + (at - low) * (rgb[low + 1][k] - value)));
  });
}

const BEYOND = 1.4263; // sqrt(chi-square, 3 axes, 95 %) / 1.96: of a vector in units of its axes' 95 % half-widths
function isBeyond(by, ci95) { // what lies within its interval is noise, and is drawn as a dot
  if (!ci95 || ci95.some((half) => !(half > 0))) return true;
  return Math.hypot(...by.map((value, axis) => value / ci95[axis])) > BEYOND;
}

function reachOf(sizes) { // a square seen from a corner is wider than its side
  const [, middle, largest] = [...sizes].sort((a, b) => a - b);
  return Math.max(largest, 0.75 * (largest + middle), 1);
}

function spaceView(host, data) {
  const table = colourTable(data.stops, 101);
  const pack = ([r, g, b]) => (255 << 24 | b << 16 | g << 8 | r) >>> 0;
  const packed = Uint32Array.from(table, pack), unsure = pack([205, 205, 205]), grey = data.grey || 0; // mm: what may be noise
  const parts = data.parts.map((part) => ({ ...part, on: true, points: Float32Array.from(part.points) }));
  const joints = data.joints || [], marks = data.marks || [], regions = data.regions || [], origin = data.origin || [0, 0, 0];
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  const hold = (p) => p.forEach((value, k) => { low[k] = Math.min(low[k], value); high[k] = Math.max(high[k], value); });
  for (const part of parts) {
    part.edges.forEach((edge) => edge.forEach(hold));
    for (let i = 0; i < part.points.length; i += 3) hold(Array.from(part.points.subarray(i, i + 3)));
  }
  joints.forEach((joint) => joint.at.forEach(hold));
  marks.forEach((mark) => hold(mark.at));
  const whole = { target: low.map((value, k) => (value + high[k]) / 2), reach: reachOf(low.map((v, k) => high[k] - v)) };
  const vectors = joints.flatMap((joint) => joint.gap).concat(marks.map((mark) => mark.by || []));
  const half = joints.flatMap((joint) => joint.ci95 || []).concat(marks.map((mark) => mark.ci95 || []));
  const largest = vectors.concat(vectors.length ? half : []).flat().reduce((m, v) => Math.max(m, Math.abs(v || 0)), 0);
  const camera = { yaw: -0.5, pitch: 0.35, zoom: 1, ...whole };
  const state = { times: 1, limit: data.limit, points: true, arrows: true, joint: -1 };

  const canvas = make("canvas", { className: "space", tabIndex: 0 });
  canvas.setAttribute("aria-label", say("the structure in space; arrow keys turn it, plus and minus zoom"));
  canvas.setAttribute("role", "img");
  const said = make("output", { className: "said" }, say("Drag to turn, wheel or pinch to zoom, point at something to read it."));
  const context = canvas.getContext("2d");
  let width = 0, height = 0, ratio = 1, owner = new Int32Array(0), tips = [], waiting = false;

  const hasPoints = parts.some((part) => part.points.length);
  const places = data.places || []; // to look at, where there are no joints
  const place = make("select", {}, make("option", { value: "-1" }, say("everything")),
    ...joints.map((joint, j) => make("option", { value: String(j) }, `${say("joint")} ${joint.name}`)),
    ...places.map((one, j) => make("option", { value: String(j) }, one.text)));
  const exponent = (value) => Math.log10(Math.max(value, 1));
  const slider = make("input", { type: "range", min: "0", max: "6", step: "0.02" });
  const sliderSaid = make("span", {});
  const limit = make("input", { type: "range", min: "-2", max: "1", step: "0.02", value: "0" });
  const bar = make("span", { className: "bar" });
  bar.style.background = `linear-gradient(90deg, ${table.filter((_, i) => i % 10 === 0).map((c) => `rgb(${c})`).join(",")})`;
  const least = make("span", {}), most = make("span", {});
  const tick = (text, on, act) => {
    const box = make("input", { type: "checkbox", checked: on });
    box.addEventListener("change", () => { act(box.checked); draw(); });
    return make("label", {}, box, ` ${text}`);
  };
  const button = (text, act) => {
    const found = make("button", { type: "button" }, text);
    found.addEventListener("click", () => { act(); draw(); });
    return found;
  };
  const look = (yaw, pitch) => () => { camera.yaw = yaw; camera.pitch = pitch; };
  host.append(
    make("div", { className: "tools" }, ...(joints.length + places.length ? [make("label", {}, `${say("look at")} `, place)] : []),
      button(say("side"), look(0, 0)), button(say("plan"), look(0, Math.PI / 2)), button(say("along"), look(-Math.PI / 2, 0)),
      button("+", () => zoom(1.4)), button("−", () => zoom(1 / 1.4))),
    canvas, said,
    ...(largest > 0 ? [make("div", { className: "tools" }, tick(say(data.arrows), true, (on) => { state.arrows = on; }),
      make("label", {}, `${say("drawn")} `, slider, sliderSaid))] : []),
    ...(hasPoints ? [make("div", { className: "tools" }, tick(say(data.values), true, (on) => { state.points = on; }),
      make("label", {}, `${say("colours to")} `, limit), make("span", { className: "scale" }, least, bar, most))] : []),
    make("fieldset", { className: "tools" }, make("legend", {}, say(joints.length ? "components" : "shown")),
      ...parts.map((part) => tick(part.text || part.name, true, (on) => { part.on = on; }))));

  function goTo(j) {
    const joint = joints[j] || places[j];
    state.joint = joint ? j : -1; // a joint is shown without the others, which would stand behind it
    if (!joint) Object.assign(camera, whole, { zoom: 1 });
    else {
      camera.target = [0, 1, 2].map((k) => joint.at.reduce((sum, p) => sum + p[k] / joint.at.length, 0));
      camera.reach = 2.4 * Math.max(...[0, 1, 2].map((k) => {
        const values = joint.at.map((p) => p[k]);
        return Math.max(...values) - Math.min(...values);
      }));
      camera.zoom = 1;
      const out = joint.outward;
      if (out) look(Math.hypot(out[0], out[1]) > 1e-3 ? Math.atan2(out[0], -out[1]) : 0, Math.asin(Math.min(Math.max(out[2], -1), 1)))();
    }
    const share = joint ? 0.12 : 0.04;
    setTimes(largest > 0 ? (share * camera.reach) / largest : 1);
  }
  function setTimes(times) {
    slider.value = String(exponent(times));
    state.times = 10 ** Number(slider.value);
  }
  function zoom(by) { camera.zoom = Math.min(Math.max(camera.zoom * by, 0.3), 400); }

  function axes() {
    const [cy, sy, cp, sp] = [Math.cos(camera.yaw), Math.sin(camera.yaw), Math.cos(camera.pitch), Math.sin(camera.pitch)];
    // right, up, and toward the eye; unturned the eye is at -y and looks along +y
    return [[cy, sy, 0], [-sy * sp, cy * sp, cp], [sy * cp, -cy * cp, sp]];
  }
  function projector() {
    const [right, up, near] = axes();
    const scale = (Math.min(width, 2.2 * height) / camera.reach) * 0.9 * camera.zoom;
    const [tx, ty, tz] = camera.target;
    const at = (x, y, z) => {
      const a = x - tx, b = y - ty, c = z - tz;
      return [width / 2 + scale * (a * right[0] + b * right[1] + c * right[2]),
        height / 2 - scale * (a * up[0] + b * up[1] + c * up[2]), a * near[0] + b * near[1] + c * near[2]];
    };
    at.scale = scale;
    return at;
  }

  function paint() {
    waiting = false;
    const box = canvas.getBoundingClientRect();
    ratio = Math.min(window.devicePixelRatio || 1, 2);
    width = Math.max(1, Math.round(box.width * ratio));
    height = Math.max(1, Math.round(box.height * ratio));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    const at = projector();
    const image = context.createImageData(width, height);
    new Uint32Array(image.data.buffer).fill(0xffffffff);
    owner = new Int32Array(width * height).fill(-1);
    if (state.points) paintPoints(at, new Uint32Array(image.data.buffer));
    context.putImageData(image, 0, 0);
    for (const part of parts) if (part.on) for (const edge of part.edges) line(edge.map((p) => at(...p)), part.bold ? "#000" : "#555", part.bold ? 2 : 1.2);
    tips = [];
    for (const mark of marks) if (parts[mark.part].on) circle(at, mark);
    for (const joint of joints.filter(visible)) line([0, 1, 2, 3, 0].map((k) => at(...joint.at[k])), "#222", 1);
    if (state.arrows) joints.forEach((joint, j) => visible(joint, j) && joint.at.forEach((p, k) => gap(at, joint, p, k)));
    names(at);
    sliderSaid.textContent = ` ${Number(state.times.toPrecision(2)).toLocaleString("en")} ${say("times their size")}`;
    least.textContent = `−${state.limit.toPrecision(2)} mm `;
    most.textContent = ` +${state.limit.toPrecision(2)} mm ${say(data.side || "outward")}${grey ? `; ${say("grey: within")} ±${grey.toPrecision(2)} mm` : ""}`;
  }
  function visible(_, j) { return state.joint < 0 || j === state.joint; }
  function paintPoints(at, pixels) {
    const near = state.joint < 0 ? Infinity : 1.2 * camera.reach, [tx, ty, tz] = camera.target;
    const depth = new Float32Array(width * height).fill(-Infinity);
    const least = Math.max(2, Math.round(2 * ratio * Math.min(Math.max(camera.zoom, 1), 2)));
    const size = Math.max(least, Math.min(Math.ceil(at.scale * (data.spacing || 0)), 32 * ratio)); // near to, points close up
    let first = 0;
    for (const part of parts) {
      const { points, residual } = part;
      if (part.on) for (let i = 0; i < residual.length; i++) {
        const a = points[3 * i], b = points[3 * i + 1], c = points[3 * i + 2];
        if (Math.hypot(a - tx, b - ty, c - tz) > near) continue;
        const [x, y, z] = at(a, b, c);
        const share = Math.min(Math.max(residual[i] / state.limit, -1), 1);
        const colour = Math.abs(residual[i]) < grey ? unsure : packed[Math.round(50 + 50 * share)];
        const left = Math.round(x - size / 2), top = Math.round(y - size / 2);
        if (left < 0 || top < 0 || left + size >= width || top + size >= height) continue;
        for (let v = top; v < top + size; v++) for (let u = left; u < left + size; u++) {
          const cell = v * width + u;
          if (z > depth[cell]) { depth[cell] = z; pixels[cell] = colour; owner[cell] = first + i; }
        }
      }
      first += residual.length;
    }
  }
  function line(points, colour, thick) {
    context.strokeStyle = colour;
    context.lineWidth = thick * ratio;
    context.beginPath();
    points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.stroke();
  }
  function gap(at, joint, p, k) {
    const by = joint.gap[k];
    if (by.some((value) => value === null)) return;
    const to = isBeyond(by, joint.ci95[k]) ? arrow(at, p, by) : dot(at, p);
    tips.push({ x: to[0], y: to[1], reach: 9 * ratio, text: () => `${joint.name} (${say(joint.verdict)}), ${data.keys[k]}: ${vector(by, joint.ci95[k])}` });
  }
  function circle(at, mark) {
    const [x, y] = at(...mark.at), scale = at.scale;
    const radius = Math.max(mark.radius * scale, 3 * ratio);
    context.strokeStyle = data.tones[mark.tone];
    context.lineWidth = (mark.tone ? 3 : 1.5) * ratio; // what is to be looked at stands out without colour too
    context.beginPath();
    context.arc(x, y, radius, 0, 2 * Math.PI);
    context.stroke();
    tips.push({ x, y, reach: Math.max(radius, 6 * ratio), text: () => `${mark.name}: ${mark.text}${mark.by ? `; ${vector(mark.by, mark.ci95)}` : ""}` });
    if (mark.label) label(mark.name, x + radius + 3 * ratio, y);
    if (state.arrows && mark.by && mark.by.every((value) => value !== null) && isBeyond(mark.by, mark.ci95)) arrow(at, mark.at, mark.by);
  }
  function label(text, x, y) {
    context.font = `bold ${12 * ratio}px system-ui, sans-serif`;
    context.textAlign = "left";
    context.lineWidth = 3 * ratio;
    context.strokeStyle = "#fff";
    context.strokeText(text, x, y + 4 * ratio);
    context.fillStyle = "#000";
    context.fillText(text, x, y + 4 * ratio);
  }
  function dot(at, p) {
    const to = at(...p);
    context.fillStyle = "#666";
    context.beginPath();
    context.arc(to[0], to[1], 3.5 * ratio, 0, 2 * Math.PI);
    context.fill();
    return to;
  }
  function arrow(at, p, by) {
    const from = at(...p), to = at(...p.map((value, axis) => value + state.times * by[axis]));
    line([from, to], "#000", 2);
    const angle = Math.atan2(to[1] - from[1], to[0] - from[0]);
    const head = Math.min(7 * ratio, 0.5 * Math.hypot(to[0] - from[0], to[1] - from[1]));
    line([2.7, -2.7].map((turn) => [to[0] + head * Math.cos(angle + turn), to[1] + head * Math.sin(angle + turn)])
      .flatMap((end, i) => (i ? [to, end] : [end])), "#000", 2);
    return to;
  }
  function names(at) {
    context.fillStyle = "#111";
    context.font = `${12 * ratio}px system-ui, sans-serif`;
    context.textAlign = "center";
    for (const joint of joints.filter(visible)) {
      const spots = joint.at.map((p) => at(...p));
      const x = spots.reduce((sum, p) => sum + p[0] / spots.length, 0);
      context.fillText(joint.name, x, Math.min(...spots.map((p) => p[1])) - 14 * ratio);
    }
  }
  function draw() {
    if (!waiting) { waiting = true; requestAnimationFrame(paint); }
  }

  const vector = (by, ci95) => `${["dx", "dy", "dz"].map((name, axis) => {
    const half = ci95 ? ci95[axis] : null;
    return `${name} ${millimetres(by[axis])}${half === null ? "" : ` ± ${millimetres(half)}`}`;
  }).join(", ")} mm`;
  function read(event) {
    const box = canvas.getBoundingClientRect();
    const x = (event.clientX - box.left) * ratio, y = (event.clientY - box.top) * ratio;
    const tip = tips.map((one) => ({ ...one, off: Math.hypot(one.x - x, one.y - y) })).filter((one) => one.off < one.reach)
      .sort((a, b) => a.off - b.off)[0];
    if (tip) { said.textContent = tip.text(); return; }
    let index = -1;
    for (let v = -3; v <= 3 && index < 0; v++) for (let u = -3; u <= 3 && index < 0; u++) {
      const column = Math.round(x) + u, row = Math.round(y) + v;
      if (column >= 0 && row >= 0 && column < width && row < height) index = owner[row * width + column];
    }
    for (const part of parts) {
      if (index >= 0 && index < part.residual.length) {
        const where = Array.from(part.points.subarray(3 * index, 3 * index + 3), (value, k) => (value + origin[k]).toFixed(0)).join(", ");
        const region = part.region && part.region[index] >= 0 ? `; ${regions[part.region[index]]}` : "";
        said.textContent = `${part.text || part.name}: ${millimetres(part.residual[index])} mm ${say(data.from || "from the design at")} ${where} mm${region}`;
        return;
      }
      index -= part.residual.length;
      if (index < 0) return;
    }
  }
  const fingers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (event.isTrusted) canvas.setPointerCapture(event.pointerId);
    read(event);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) { read(event); return; }
    const now = [event.clientX, event.clientY];
    const dx = now[0] - before[0], dy = now[1] - before[1];
    if (fingers.size === 1 && event.shiftKey) pan(dx, dy);
    else if (fingers.size === 1) turn(-dx * 0.008, dy * 0.008);
    else if (fingers.size === 2) {
      const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
      zoom(apart(now) / Math.max(apart(before), 1));
      pan(dx / 2, dy / 2);
    }
    fingers.set(event.pointerId, now);
    draw();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * 0.0015));
    draw();
  }, { passive: false });
  const keys = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
  canvas.addEventListener("keydown", (event) => {
    if (event.key in keys) turn(...keys[event.key]);
    else if (event.key === "+" || event.key === "=") zoom(1.2);
    else if (event.key === "-") zoom(1 / 1.2);
    else return;
    event.preventDefault();
    draw();
  });
  function turn(yaw, pitch) {
    camera.yaw += yaw;
    camera.pitch = Math.min(Math.max(camera.pitch + pitch, -Math.PI / 2), Math.PI / 2);
  }
  function pan(dx, dy) {
    const [right, up] = axes();
    const scale = ((Math.min(width, 2.2 * height) / camera.reach) * 0.9 * camera.zoom) / ratio;
    camera.target = camera.target.map((value, k) => value - (dx * right[k] - dy * up[k]) / scale);
  }
  place.addEventListener("change", () => { goTo(Number(place.value)); draw(); });
  slider.addEventListener("input", () => { state.times = 10 ** Number(slider.value); draw(); });
  limit.addEventListener("input", () => { state.limit = data.limit * 10 ** Number(limit.value); draw(); });
  new ResizeObserver(draw).observe(canvas);
  goTo(-1);
  draw();
}
