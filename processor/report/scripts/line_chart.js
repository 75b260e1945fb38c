// A chart of lines with bands: names switch lines off and on, pointing at a line shows its nearest values.
function lineChart(host, wanted) {
  const { xLabel, yLabel, series, logX, note } = wanted;
  let logY = wanted.logY;
  const canvas = make("canvas", { className: "chart" });
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", `${yLabel} ${say("against")} ${xLabel}`);
  const said = make("output", { className: "said" }, say("Point at a line to read it; names switch lines on and off."));
  const context = canvas.getContext("2d");
  const lines = series.map((one) => ({ ...one, on: !one.further }));
  let waiting = false, ratio = 1, spots = [];
  const swatch = (one) => {
    const found = make("span", { className: "swatch" });
    found.style.borderTop = `${one.thin ? 1 : 3}px ${["solid", "dashed", "dotted", "double"][one.style % 4]} ${one.colour}`;
    return found;
  };
  const tick = (parts, on, act) => {
    const box = make("input", { type: "checkbox", checked: on });
    box.addEventListener("change", () => { act(box.checked); draw(); });
    return make("label", {}, box, ...parts);
  };
  host.append(canvas, said, make("div", { className: "tools" },
    ...lines.map((one) => tick([swatch(one), one.name], one.on, (on) => { one.on = on; })),
    ...(logX ? [] : [tick([` ${say("logarithmic")}`], logY, (on) => { logY = on; })])));
  if (note) host.append(make("p", { className: "soft" }, note));

  function ticks(low, high, log) {
    const found = [];
    if (log && high > 3 * low) {
      for (let ten = Math.floor(Math.log10(low)); ten <= Math.log10(high); ten++) {
        for (const step of high / low > 60 ? [1] : [1, 2, 5]) found.push(step * 10 ** ten);
      }
      return found.filter((value) => value >= low && value <= high);
    }
    const rough = (high - low) / 5, ten = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((value) => value * ten).find((value) => value >= rough);
    for (let value = Math.ceil(low / step) * step; value <= high; value += step) found.push(value);
    return found;
  }
  const short = (value) => String(Number(value.toPrecision(3)));

  function paint() {
    waiting = false;
    const box = canvas.getBoundingClientRect();
    ratio = Math.min(window.devicePixelRatio || 1, 2);
    canvas.width = Math.max(1, Math.round(box.width * ratio));
    canvas.height = Math.max(1, Math.round(box.height * ratio));
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const frame = { left: 58, top: 10, right: box.width - 12, bottom: box.height - 42 };
    const shown = lines.filter((one) => one.on);
    const xs = shown.flatMap((one) => one.x), ys = shown.flatMap((one) => one.y.concat(one.high || []));
    const fits = (values, log) => values.filter((value) => value !== null && (!log || value > 0));
    const ends = (values, log) => {
      const known = fits(values, log);
      if (!known.length) return [log ? 0.1 : 0, 1];
      const low = known.reduce((a, b) => Math.min(a, b)), high = known.reduce((a, b) => Math.max(a, b));
      if (log) return [Math.max(low, high / 1e6) / 1.25, high * 1.6]; // room for what is written at the points
      return [Math.min(low, 0), high > low ? high * 1.05 : low + 1];
    };
    const [x0, x1] = ends(xs, logX), [y0, y1] = ends(ys, logY);
    const scale = (value, low, high, a, b, log) => {
      const share = log ? Math.log(Math.max(value, low) / low) / Math.log(high / low) : (value - low) / (high - low);
      return a + share * (b - a);
    };
    const px = (value) => scale(value, x0, x1, frame.left, frame.right, logX);
    const py = (value) => scale(value, y0, y1, frame.bottom, frame.top, logY);
    context.fillStyle = "#fff";
    context.fillRect(0, 0, box.width, box.height);
    context.font = "12px system-ui, sans-serif";
    context.lineWidth = 1;
    context.strokeStyle = "#ddd";
    context.fillStyle = "#333";
    for (const value of ticks(x0, x1, logX)) {
      stroke([[px(value), frame.top], [px(value), frame.bottom]]);
      context.textAlign = "center";
      context.fillText(short(value), px(value), frame.bottom + 15);
    }
    for (const value of ticks(y0, y1, logY)) {
      stroke([[frame.left, py(value)], [frame.right, py(value)]]);
      context.textAlign = "right";
      context.fillText(short(value), frame.left - 6, py(value) + 4);
    }
    context.textAlign = "center";
    context.fillText(xLabel, (frame.left + frame.right) / 2, box.height - 8);
    context.save();
    context.translate(13, (frame.top + frame.bottom) / 2);
    context.rotate(-Math.PI / 2);
    context.fillText(yLabel, 0, 0);
    context.restore();
    context.strokeStyle = "#555";
    context.strokeRect(frame.left, frame.top, frame.right - frame.left, frame.bottom - frame.top);
    spots = [];
    for (const one of shown) {
      if (one.high) band(one, px, py);
      const path = one.x.map((x, i) => [px(x), py(one.y[i]), i]).filter(([, , i]) => one.y[i] !== null);
      context.strokeStyle = one.colour;
      context.lineWidth = one.thin ? 1 : 2;
      context.setLineDash([[], [7, 4], [2, 3], [8, 3, 2, 3]][one.style % 4]);
      stroke(path);
      context.setLineDash([]);
      for (const [x, y, i] of path) spots.push({ x, y, one, i });
      if (one.labels) marks(one, path);
    }
  }
  function stroke(path) {
    context.beginPath();
    path.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.stroke();
  }
  function band(one, px, py) {
    const known = one.x.map((_, i) => i).filter((i) => one.high[i] !== null && one.low[i] !== null);
    const path = known.map((i) => [px(one.x[i]), py(one.high[i])])
      .concat(known.reverse().map((i) => [px(one.x[i]), py(one.low[i])]));
    context.globalAlpha = 0.2;
    context.fillStyle = one.colour;
    context.beginPath();
    path.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.fill();
    context.globalAlpha = 1;
  }
  function marks(one, path) {
    context.textAlign = "left";
    for (const [x, y, i] of path) {
      context.fillStyle = one.colour;
      context.beginPath();
      context.arc(x, y, 4, 0, 7);
      context.fill();
      if (i === one.own) {
        context.lineWidth = 2;
        context.strokeStyle = "#D55E00";
        context.strokeRect(x - 8, y - 8, 16, 16);
      }
      context.fillStyle = "#111";
      context.fillText(one.labels[i], x + 10, y - 7);
    }
  }
  function draw() {
    if (!waiting) { waiting = true; requestAnimationFrame(paint); }
  }
  for (const kind of ["pointermove", "pointerdown"]) canvas.addEventListener(kind, (event) => {
    const box = canvas.getBoundingClientRect();
    const x = event.clientX - box.left, y = event.clientY - box.top;
    let best = null, off = 30;
    for (const spot of spots) {
      const now = Math.hypot(spot.x - x, spot.y - y);
      if (now < off) { off = now; best = spot; }
    }
    if (best) said.textContent = best.one.read(best.i);
  });
  new ResizeObserver(draw).observe(canvas);
  draw();
}
