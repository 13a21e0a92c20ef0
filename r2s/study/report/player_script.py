"""The style and the script of `viewer`: plain CSS and JavaScript, which fetch nothing.

The element of a viewer has `viewer.positions(label)`: what is shown of a column, or without a label
of the recording, [m], and `viewer.draw()`.
"""

STYLE = """
.viewer .controls { display: flex; flex-wrap: wrap; gap: .6rem; align-items: center; }
.viewer .controls label { display: flex; gap: .5rem; align-items: center; max-width: 100%; }
.viewer select { min-width: 0; text-overflow: ellipsis; }
.viewer select, .viewer button { font: inherit; color: inherit; background: var(--soft);
  border: 1px solid var(--line); border-radius: .3rem; padding: .25rem .6rem; max-width: 100%; }
.viewer input[type=range] { flex: 1 1 10rem; min-width: 8rem; }
.viewer output { min-width: 7.5rem; font-variant-numeric: tabular-nums; }
.viewer canvas { display: block; width: 100%; height: min(70vh, 34rem); margin: .6rem 0;
  border: 1px solid var(--line); border-radius: .3rem; touch-action: none; cursor: grab; }
.viewer .legend { display: flex; flex-wrap: wrap; gap: .2rem 1rem; }
.viewer .legend label { display: flex; align-items: center; gap: .35rem; font-size: .9rem; }
.viewer .legend i { width: 1rem; height: 1rem; border-radius: .2rem; flex: none; }
.viewer .hint { color: var(--dim); font-size: .85rem; }
"""

SCRIPT = """
(() => {
  const root = document.getElementById(VIEWER_NAME);
  const find = what => root.querySelector(what);
  const data = JSON.parse(find("script[type='application/json']").textContent);
  const canvas = find("canvas"), pen = canvas.getContext("2d"), slider = find("input[type=range]");
  const button = find("button"), choice = find("select"), clock = find("output");
  const home = { azimuth: -1.05, elevation: 0.35, zoom: 1 };
  const view = { ...home }, ticked = new Set(data.labels.slice(0, 2)), boxes = new Map();
  let current = null, playing = null;

  const bytes = text => Uint8Array.from(atob(text.slice(7)), c => c.charCodeAt(0)).buffer;
  const metres = (text, middle) => {
    const steps = new Int16Array(bytes(text)), out = new Float32Array(steps.length);
    for (let i = 0; i < steps.length; i++)
      out[i] = steps[i] === data.absent ? NaN : steps[i] * data.step + middle[i % 3];
    return out;
  };
  const open = index => {
    const from = data.recordings[index], sheets = {};
    const faces = {};
    for (const label in from.sheets) {
      sheets[label] = metres(from.sheets[label], from.middle);
      faces[label] = new Uint16Array(bytes(from.faces[label]));
    }
    const starts = [0];
    for (const count of from.counts) starts.push(starts[starts.length - 1] + count);
    current = { ...from, sheets, faces, starts, points: metres(from.points, from.middle) };
    slider.max = from.times.length - 1;
    slider.value = Math.floor(0.6 * slider.max);
    for (const [label, box] of boxes) {
      box.disabled = !(label in sheets);
      box.parentNode.style.opacity = box.disabled ? 0.4 : 1;
    }
  };

  const camera = () => {
    const a = view.azimuth, e = view.elevation, [ca, sa, ce, se] =
      [Math.cos(a), Math.sin(a), Math.cos(e), Math.sin(e)];
    const wide = canvas.clientWidth, high = canvas.clientHeight;
    const scale = 0.6 * Math.min(wide, high) / current.radius * view.zoom;
    const [mx, my, mz] = current.middle;
    const turn = (x, y, z) => [-sa * x + ca * y, -se * ca * x - se * sa * y + ce * z,
      ce * ca * x + ce * sa * y + se * z];
    const place = (x, y, z) => {
      const [right, up, near] = turn(x - mx, y - my, z - mz);
      return [wide / 2 + scale * right, high / 2 - scale * up, near];
    };
    return { wide, high, scale, turn, place };
  };

  const shade = (colour, light) => {
    const number = parseInt(colour.slice(1), 16);
    const part = shift => Math.round(((number >> shift) & 255) * light);
    return "rgba(" + part(16) + "," + part(8) + "," + part(0) + ",0.6)";
  };

  const triangles = (things, label, place) => {
    const x = current.sheets[label];
    if (!x) return;
    const colour = data.colours[data.labels.indexOf(label)];
    const vertices = x.length / 3 / current.times.length, first = vertices * slider.value;
    const at = i => 3 * (first + i);
    let drawn = 0;
    const faces = current.faces[label];
    for (let f = 0; f < faces.length; f += 3) {
      const corners = [0, 1, 2].map(k => at(faces[f + k]));
      if (corners.some(i => isNaN(x[i]))) continue;
      drawn++;
      const [p, q, r] = corners.map(i => place(x[i], x[i + 1], x[i + 2]));
      const flat = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]);
      const [i, j, k] = corners, u = [0, 1, 2].map(c => x[j + c] - x[i + c]);
      const v = [0, 1, 2].map(c => x[k + c] - x[i + c]);
      const area = Math.hypot(u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2],
        u[0] * v[1] - u[1] * v[0]);
      const facing = Math.abs(flat) / (area * scaleNow * scaleNow + 1e-12);
      things.push({ near: (p[2] + q[2] + r[2]) / 3, corners: [p, q, r],
        fill: shade(colour, 0.62 + 0.38 * Math.min(1, facing)) });
    }
    boxes.get(label).parentNode.lastChild.textContent = drawn ? label : label + " (diverged)";
  };
  let scaleNow = 1;

  const draw = () => {
    const dense = window.devicePixelRatio || 1;
    const size = [canvas.clientWidth * dense, canvas.clientHeight * dense].map(Math.round);
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    pen.setTransform(dense, 0, 0, dense, 0, 0);
    const eye = camera(), ink = getComputedStyle(root).color, things = [];
    scaleNow = eye.scale;
    pen.clearRect(0, 0, eye.wide, eye.high);
    for (const label of data.labels) if (ticked.has(label)) triangles(things, label, eye.place);
    if (ticked.has("")) {
      const x = current.points, frame = +slider.value;
      for (let i = 3 * current.starts[frame]; i < 3 * current.starts[frame + 1]; i += 3) {
        const dot = eye.place(x[i], x[i + 1], x[i + 2]);
        things.push({ near: dot[2], dot, fill: ink });
      }
    }
    things.sort((a, b) => a.near - b.near);
    for (const { corners, dot, fill } of things) {
      pen.fillStyle = fill;
      if (dot) { pen.fillRect(dot[0] - 1, dot[1] - 1, 2, 2); continue; }
      pen.beginPath();
      corners.forEach((p, i) => i ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1]));
      pen.closePath();
      pen.fill();
      pen.strokeStyle = fill;
      pen.lineWidth = 0.7;
      pen.stroke();
    }
    ruler(eye, ink);
    axes(eye, ink);
    const frame = +slider.value, time = current.times[frame];
    clock.textContent = "frame " + frame + ", " + time.toFixed(2) + " s";
  };

  const ruler = (eye, ink) => {
    const rough = 130 / eye.scale, ten = 10 ** Math.floor(Math.log10(rough));
    const length = [5, 2, 1].map(n => n * ten).find(n => n <= rough), end = 20 + length * eye.scale;
    pen.strokeStyle = pen.fillStyle = ink;
    pen.lineWidth = 2;
    pen.beginPath();
    for (const [x, y] of [[20, -6], [20, 0], [end, 0], [end, -6]]) pen.lineTo(x, eye.high - 16 + y);
    pen.stroke();
    pen.font = "13px system-ui, sans-serif";
    pen.textAlign = "left";
    pen.fillText(+length.toPrecision(1) + " m", 24, eye.high - 24);
  };

  const axes = (eye, ink) => {
    const from = [eye.wide - 45, eye.high - 45];
    pen.strokeStyle = pen.fillStyle = ink;
    pen.lineWidth = 1.2;
    pen.textAlign = "center";
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]].forEach((axis, i) => {
      const [right, up] = eye.turn(...axis);
      pen.beginPath();
      pen.moveTo(...from);
      pen.lineTo(from[0] + 26 * right, from[1] - 26 * up);
      pen.stroke();
      pen.fillText("xyz"[i], from[0] + 36 * right, from[1] - 36 * up + 4);
    });
  };

  const play = now => {
    if (!playing) return;
    const times = current.times, last = times.length - 1;
    const passed = (now - playing.since) / 1000 + times[playing.frame];
    let frame = playing.frame;
    while (frame < last && times[frame + 1] <= passed) frame++;
    if (+slider.value !== frame) { slider.value = frame; draw(); }
    if (frame === last) { stop(); return; }
    requestAnimationFrame(play);
  };
  const stop = () => { playing = null; button.textContent = "Play"; };
  button.addEventListener("click", () => {
    if (playing) { stop(); return; }
    if (+slider.value === +slider.max) slider.value = 0;
    playing = { frame: +slider.value, since: performance.now() };
    button.textContent = "Pause";
    requestAnimationFrame(play);
  });
  slider.addEventListener("input", () => { stop(); draw(); });
  choice.addEventListener("change", () => {
    stop();
    open(+choice.value);
    draw();
  });

  const held = new Map();
  const zoom = factor => {
    view.zoom = Math.min(20, Math.max(0.2, view.zoom * factor));
    draw();
  };
  const turn = (right, down) => {
    view.azimuth -= right;
    view.elevation = Math.min(1.57, Math.max(-1.57, view.elevation + down));
    draw();
  };
  const spread = () => {
    const [a, b] = [...held.values()];
    return Math.hypot(a[0] - b[0], a[1] - b[1]);
  };
  canvas.addEventListener("pointerdown", event => {
    try { canvas.setPointerCapture(event.pointerId); } catch { }
    held.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", event => {
    const before = held.get(event.pointerId);
    if (!before) return;
    const apart = held.size === 2 ? spread() : 0;
    held.set(event.pointerId, [event.clientX, event.clientY]);
    if (held.size === 2) zoom(spread() / (apart || 1));
    else turn((event.clientX - before[0]) / 150, (event.clientY - before[1]) / 150);
  });
  for (const end of ["pointerup", "pointercancel"])
    canvas.addEventListener(end, event => held.delete(event.pointerId));
  /* Only once the canvas was clicked: else the page could not be scrolled over it. */
  canvas.addEventListener("wheel", event => {
    if (document.activeElement !== canvas) return;
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 500));
  }, { passive: false });
  canvas.addEventListener("dblclick", () => { Object.assign(view, home); draw(); });
  canvas.addEventListener("keydown", event => {
    const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1],
      ArrowDown: [0, 0.1] }, zooms = { "+": 1.15, "-": 1 / 1.15 };
    if (event.key in turns) turn(...turns[event.key]);
    else if (event.key in zooms) zoom(zooms[event.key]);
    else return;
    event.preventDefault();
  });

  const legend = (label, text, colour, on) => {
    const line = document.createElement("label"), box = document.createElement("input");
    const patch = document.createElement("i");
    box.type = "checkbox";
    box.checked = on;
    patch.style.background = colour;
    line.append(box, patch, text);
    find(".legend").append(line);
    if (on) ticked.add(label);
    box.addEventListener("change", () => {
      box.checked ? ticked.add(label) : ticked.delete(label);
      draw();
    });
    return box;
  };
  legend("", "recorded points", "currentColor", true);
  data.labels.forEach((label, i) =>
    boxes.set(label, legend(label, label, data.colours[i], ticked.has(label))));
  open(0);
  new ResizeObserver(draw).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  root.viewer = { draw, positions: label => label ? current.sheets[label] : current.points };
  draw();
})();
"""
