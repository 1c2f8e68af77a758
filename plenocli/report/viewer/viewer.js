"use strict";
// The viewer. Numbers are unpacked once into Float32Array; every picture is painted on a canvas of
// its own size, one pixel a value, and scaled by the style sheet. Rows go down and come first.
(() => {
  const SPECTRA = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"];
  const ANCHORS = {
    level: ["440154", "482878", "3e4a89", "31688e", "26828e", "1f9e89", "35b779", "6ece58", "b5de2b", "fde725"],
    sign: ["053061", "2166ac", "4393c3", "92c5de", "d1e5f0", "f7f7f7", "fddbc7", "f4a582", "d6604d", "b2182b", "67001f"],
  };
  const SHADES = 4096;
  const srgb = (v) => 255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * Math.pow(v, 1 / 2.4) - 0.055);
  const clamp = (v, low, high) => Math.min(high, Math.max(low, v));
  const told = (v) => (Number.isNaN(v) ? "unknown" : Number(v.toPrecision(4)).toString());

  /** Colours of a map: one Uint32 (ABGR) a shade. */
  function shades(name) {
    const table = new Uint32Array(SHADES);
    const anchors = (ANCHORS[name] || []).map((h) => [0, 2, 4].map((i) => parseInt(h.slice(i, i + 2), 16)));
    for (let i = 0; i < SHADES; i++) {
      const t = i / (SHADES - 1);
      let rgb = Array(3).fill(srgb(t));
      if (anchors.length) {
        const at = Math.min(t * (anchors.length - 1), anchors.length - 1 - 1e-9), low = Math.floor(at);
        rgb = anchors[low].map((v, k) => v + (anchors[low + 1][k] - v) * (at - low));
      }
      table[i] = 0xff000000 | (Math.round(rgb[2]) << 16) | (Math.round(rgb[1]) << 8) | Math.round(rgb[0]);
    }
    return table;
  }
  const MAPS = { light: shades("light"), level: shades("level"), sign: shades("sign") };
  const UNKNOWN = 0xff808080;

  function el(tag, props = {}, ...children) {
    const made = Object.assign(document.createElement(tag), props);
    made.append(...children);
    return made;
  }

  async function unpack(packed) {
    const text = atob(packed.data), bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    const both = new Uint8Array(await new Response(stream).arrayBuffer());
    const n = both.length / 2, values = new Float32Array(n), step = (packed.high - packed.low) / 65534;
    for (let i = 0; i < n; i++) {
      const q = both[i] | (both[n + i] << 8);
      values[i] = q === 65535 ? NaN : packed.low + q * step;
    }
    return { shape: packed.shape, values };
  }

  async function unpackAll(value) {
    if (Array.isArray(value)) return Promise.all(value.map(unpackAll));
    if (!value || typeof value !== "object") return value;
    if (typeof value.data === "string" && Array.isArray(value.shape)) return unpack(value);
    const entries = Object.entries(value).map(async ([k, v]) => [k, await unpackAll(v)]);
    return Object.fromEntries(await Promise.all(entries));
  }

  /** A canvas for pictures of one size; paint(values, start, layer, gain, from column, to column). */
  class Picture {
    constructor(rows, cols, { smooth = false, aspect = 1, most = 620 } = {}) {
      this.rows = rows; this.cols = cols;
      this.canvas = el("canvas", { width: cols, height: rows });
      this.canvas.style.aspectRatio = `${cols} / ${rows * aspect}`;
      this.box = el("div", { className: smooth ? "picture smooth" : "picture" }, this.canvas);
      this.box.style.maxWidth = `${Math.min(900, Math.round(most * cols / (rows * aspect)))}px`;
      this.pen = this.canvas.getContext("2d");
      this.image = this.pen.createImageData(cols, rows);
      this.pixels = new Uint32Array(this.image.data.buffer);
    }
    paint(values, start, layer, gain, from = 0, to = this.cols) {
      const { rows, cols, pixels } = this, size = rows * cols;
      const low = layer.low, scale = (SHADES - 1) * gain / (layer.high - layer.low || 1), top = SHADES - 1;
      const table = MAPS[layer.map], middle = layer.map === "sign" ? (1 - gain) * top / 2 : 0;
      for (let r = 0; r < rows; r++) {
        for (let i = r * cols + from, end = r * cols + to; i < end; i++) {
          if (layer.map === "colour") {
            const rgb = [0, 1, 2].map((k) => Math.round(srgb(clamp(values[k * size + i] * gain, 0, 1))));
            pixels[i] = 0xff000000 | (rgb[2] << 16) | (rgb[1] << 8) | rgb[0];
            continue;
          }
          const v = values[start + i];
          if (v !== v) { pixels[i] = UNKNOWN; continue; }
          const shade = (v - low) * scale + middle;
          pixels[i] = table[shade <= 0 ? 0 : shade >= top ? top : (shade + 0.5) | 0];
        }
      }
    }
    /** Channels that follow each other in `values`, as colour: rows of `rgb` make R, G and B of them; what is unknown of a channel counts as none. */
    paintChannels(values, start, rgb, high, gain) {
      const { pixels } = this, size = this.rows * this.cols, count = rgb[0].length, top = SHADES - 1, scale = top * gain / (high || 1);
      for (let i = 0; i < size; i++) {
        let r = 0, g = 0, b = 0, known = false;
        for (let k = 0, at = start + i; k < count; k++, at += size) {
          const v = values[at];
          if (v === v) { known = true; r += rgb[0][k] * v; g += rgb[1][k] * v; b += rgb[2][k] * v; }
        }
        if (!known) { pixels[i] = UNKNOWN; continue; }
        r *= scale; g *= scale; b *= scale;
        pixels[i] = 0xff000000 | (MAPS.light[b <= 0 ? 0 : b >= top ? top : b | 0] & 0xff0000) | (MAPS.light[g <= 0 ? 0 : g >= top ? top : g | 0] & 0xff00) | (MAPS.light[r <= 0 ? 0 : r >= top ? top : r | 0] & 0xff);
      }
    }
    show() { this.pen.putImageData(this.image, 0, 0); }
    /** Row and column under the pointer, whole numbers within the picture. */
    at(event) {
      const box = this.canvas.getBoundingClientRect();
      return [
        clamp(Math.floor((event.clientY - box.top) / box.height * this.rows), 0, this.rows - 1),
        clamp(Math.floor((event.clientX - box.left) / box.width * this.cols), 0, this.cols - 1),
      ];
    }
    /** Calls: hover(row, column), leave(), click(row, column), drag(dx, dy, x) in shares of the picture. */
    listen({ hover, leave, click, drag }) {
      let from = null, moved = false, last = null;
      this.box.addEventListener("pointerdown", (e) => { from = last = e; moved = false; this.box.setPointerCapture(e.pointerId); });
      this.box.addEventListener("pointermove", (e) => {
        if (hover) hover(...this.at(e));
        if (!from) return;
        if (Math.hypot(e.clientX - from.clientX, e.clientY - from.clientY) > 4) moved = true;
        if (moved && drag) {
          const box = this.canvas.getBoundingClientRect();
          drag((e.clientX - last.clientX) / box.width, (e.clientY - last.clientY) / box.height, clamp((e.clientX - box.left) / box.width, 0, 1));
          last = e;
        }
      });
      this.box.addEventListener("pointerup", (e) => { if (from && !moved && click) click(...this.at(e)); from = null; });
      this.box.addEventListener("pointercancel", () => { from = null; });
      this.box.addEventListener("pointerleave", () => { if (!from && leave) leave(); });
    }
    mark(row, col, colour) {
      const dot = el("i", { className: "mark" });
      dot.style.cssText = `top:${(row + 0.5) / this.rows * 100}%;left:${(col + 0.5) / this.cols * 100}%;border-color:${colour}`;
      this.box.append(dot);
      return dot;
    }
  }

  function slider(name, low, high, step, value, onInput) {
    const input = el("input", { type: "range", min: low, max: high, step });
    input.value = value;
    input.setAttribute("aria-label", name);
    const text = el("output");
    input.addEventListener("input", () => onInput(Number(input.value)));
    return { input, text, box: el("label", { className: "slide" }, el("span", { textContent: name }), text, input),
      move(steps) { input.value = Number(input.value) + steps * step; onInput(Number(input.value)); } };
  }

  function choice(name, options, value, onChange) {
    const select = el("select", {}, ...options.map((o, i) => el("option", { value: i, textContent: o })));
    select.value = value;
    select.addEventListener("change", () => onChange(Number(select.value)));
    return { select, box: el("label", { className: "choice" }, name, select) };
  }

  const nodes = (tag, attrs, text) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [k, v] of Object.entries(attrs)) made.setAttribute(k, v);
    if (text !== undefined) made.textContent = text;
    return made;
  };

  function nice(low, high, count) {
    const raw = (high - low) / count, ten = 10 ** Math.floor(Math.log10(raw));
    const step = ten * [1, 2, 5, 10].find((m) => m * ten >= raw);
    const found = [];
    for (let v = Math.ceil(low / step) * step; v <= high + step * 1e-9; v += step) found.push(Number(v.toPrecision(10)));
    return found;
  }

  /** Lines with error bars: each {x, y, half, colour, dashed}. */
  function plot(lines, axis, unit) {
    const W = 400, H = 260, L = 50, B = 40, T = 12, R = 10;
    const svg = nodes("svg", { class: "plot", viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": `${unit} over ${axis}` });
    const xs = lines.flatMap((l) => l.x);
    const ys = lines.flatMap((l) => l.y.flatMap((v, i) => [v - (l.half ? l.half[i] : 0), v + (l.half ? l.half[i] : 0)])).filter(Number.isFinite);
    if (!ys.length) return svg;
    let [x0, x1] = [Math.min(...xs), Math.max(...xs)], [y0, y1] = [Math.min(0, ...ys), Math.max(...ys)];
    if (x1 === x0) { x0 -= 1; x1 += 1; }
    if (y1 === y0) y1 += 1;
    const pad = 0.04; x0 -= pad * (x1 - x0); x1 += pad * (x1 - x0); y1 += pad * (y1 - y0);
    const X = (v) => L + (v - x0) / (x1 - x0) * (W - L - R), Y = (v) => H - B - (v - y0) / (y1 - y0) * (H - B - T);
    for (const v of nice(y0, y1, 4)) {
      svg.append(nodes("line", { x1: L, x2: W - R, y1: Y(v), y2: Y(v), stroke: "currentColor", opacity: 0.14 }));
      svg.append(nodes("text", { x: L - 6, y: Y(v) + 4, "text-anchor": "end" }, told(v)));
    }
    for (const v of nice(x0, x1, 5)) svg.append(nodes("text", { x: X(v), y: H - B + 16, "text-anchor": "middle" }, told(v)));
    svg.append(nodes("text", { x: (L + W - R) / 2, y: H - 6, "text-anchor": "middle" }, axis));
    for (const line of lines) {
      const points = line.x.map((x, i) => [X(x), Y(line.y[i])]).filter((p) => Number.isFinite(p[1]));
      svg.append(nodes("polyline", { points: points.join(" "), fill: "none", stroke: line.colour, "stroke-width": 1.6, "stroke-dasharray": line.dashed ? "4 3" : "none" }));
      line.x.forEach((x, i) => {
        const half = line.half ? line.half[i] : NaN;
        if (Number.isFinite(half) && Number.isFinite(line.y[i])) {
          svg.append(nodes("path", { class: "bar", d: `M${X(x)} ${Y(line.y[i] - half)}V${Y(line.y[i] + half)}M${X(x) - 3} ${Y(line.y[i] - half)}h6M${X(x) - 3} ${Y(line.y[i] + half)}h6`, stroke: line.colour, fill: "none" }));
        }
      });
      for (const [x, y] of line.dashed ? [] : points) svg.append(nodes("circle", { cx: x, cy: y, r: 2.6, fill: line.colour }));
    }
    return svg;
  }

  class Panel {
    constructor(data) {
      this.data = data; this.gain = 1;
      this.readout = el("output", { className: "readout" });
      this.root = el("section", { className: "panel", hidden: true },
        el("h2", { textContent: data.title }), el("p", { className: "caption", textContent: data.caption + (data.block > 1 ? ` One value is the mean of ${data.block} × ${data.block} in the file.` : "") }));
    }
    lay(pictures, controls) {
      const side = el("div", {}, el("div", { className: "controls" }, ...controls), this.readout);
      this.side = side;
      this.root.append(el("div", { className: "body" }, el("div", {}, ...pictures), side));
    }
    brighter(factor) { this.gain = clamp(this.gain * factor, 1 / 64, 64); this.draw(); }
  }

  /** Layers over each other: planes, a wipe, spectra. */
  class Stack extends Panel {
    constructor(data) {
      super(data);
      const [, rows, cols] = data.layers[0].values.shape;
      this.size = rows * cols; this.cols = cols; this.plane = 0; this.share = 0.5; this.clicked = [];
      const start = data.layers.findIndex((l) => l.map === "colour");
      this.left = start < 0 ? 0 : start; this.right = start < 0 ? Math.min(1, data.layers.length - 1) : 0;
      this.picture = new Picture(rows, cols);
      const controls = [];
      if (data.layers.length > 1) {
        const names = data.layers.map((l) => l.name);
        this.choices = [choice("left", names, this.left, (v) => { this.left = v; this.draw(); }), choice("right", names, this.right, (v) => { this.right = v; this.draw(); })];
        this.line = el("i", { className: "wipe" });
        this.tags = [el("span", { className: "tag left" }), el("span", { className: "tag right" })];
        this.picture.box.append(this.line, ...this.tags);
        this.wipe = slider("wipe", 0, 1, 0.01, 0.5, (v) => { this.share = v; this.draw(); });
        controls.push(...this.choices.map((c) => c.box), this.wipe.box);
      }
      if (data.labels.length > 1) {
        this.planes = slider(data.axis || "plane", 0, data.labels.length - 1, 1, 0, (v) => { this.plane = v; this.draw(); });
        controls.push(this.planes.box);
      }
      this.lay([this.picture.box], controls);
      this.figure = el("div");
      this.side.append(this.figure);
      this.picture.listen({
        hover: (r, c) => this.tell(r, c), leave: () => { this.readout.textContent = this.hint(); },
        click: (r, c) => this.add(r, c), drag: (dx, dy, x) => { if (this.wipe) { this.wipe.input.value = this.share = x; this.draw(); } },
      });
      this.readout.textContent = this.hint();
      if (data.ticks) this.add(rows >> 1, cols >> 1);
    }
    hint() { return this.data.ticks ? "Click the picture for a spectrum." : "Point at the picture for its values."; }
    start(layer) { return layer.map === "colour" ? 0 : Math.min(this.plane, layer.values.shape[0] - 1) * this.size; }
    draw() {
      const { layers, labels } = this.data, edge = this.wipe ? Math.round(this.share * this.cols) : this.cols;
      const [a, b] = [layers[this.left], layers[this.right]];
      this.picture.paint(a.values.values, this.start(a), a, this.gain, 0, edge);
      if (edge < this.cols) this.picture.paint(b.values.values, this.start(b), b, this.gain, edge, this.cols);
      this.picture.show();
      if (this.wipe) {
        this.line.style.left = `${edge / this.cols * 100}%`;
        this.line.hidden = this.left === this.right;
        this.tags[0].textContent = a.name; this.tags[1].textContent = b.name;
        this.tags[1].hidden = this.left === this.right;
        this.wipe.text.textContent = `${Math.round(this.share * 100)} %`;
      }
      if (this.planes) this.planes.text.textContent = labels[this.plane];
    }
    tell(r, c) {
      const block = this.data.block;
      const place = block > 1 ? `rows ${r * block} to ${(r + 1) * block - 1}, columns ${c * block} to ${(c + 1) * block - 1}` : `row ${r}, column ${c}`;
      const parts = this.data.layers.filter((l) => l.map !== "colour").map((l) => `${l.name} ${told(l.values.values[this.start(l) + r * this.cols + c])}${l.unit ? " " + l.unit : ""}`);
      this.readout.textContent = `${place}: ${parts.join(" · ")}`;
    }
    along(number, r, c) {
      const values = this.data.layers[number].values.values, found = [];
      for (let p = 0; p < this.data.ticks.length; p++) found.push(values[p * this.size + r * this.cols + c]);
      return found;
    }
    add(r, c) {
      if (!this.data.ticks) return;
      if (this.clicked.length === SPECTRA.length) this.clicked.shift().dot.remove();
      const colour = SPECTRA.find((s) => !this.clicked.some((one) => one.colour === s));
      this.clicked.push({ r, c, colour, dot: this.picture.mark(r, c, colour) });
      this.tell(r, c); this.spectra();
    }
    spectra() {
      const { data } = this, truth = data.layers.findIndex((l) => l.name === "truth");
      const lines = this.clicked.flatMap(({ r, c, colour }) => {
        const half = data.bars === null ? null : this.along(data.bars, r, c).map((s) => 1.96 * s);
        const one = [{ x: data.ticks, y: this.along(data.drawn, r, c), half, colour }];
        return truth < 0 ? one : [...one, { x: data.ticks, y: this.along(truth, r, c), colour, dashed: true }];
      });
      this.figure.replaceChildren(...(lines.length ? [plot(lines, data.axis, data.layers[data.drawn].unit)] : []));
    }
    key(k) {
      if (k === "ArrowLeft" || k === "ArrowRight") { if (!this.planes) return false; this.planes.move(k === "ArrowLeft" ? -1 : 1); }
      else if ((k === "ArrowUp" || k === "ArrowDown") && this.wipe) this.wipe.move(k === "ArrowUp" ? 5 : -5);
      else if (k === "x" && this.choices) {
        [this.left, this.right] = [this.right, this.left];
        this.choices[0].select.value = this.left; this.choices[1].select.value = this.right; this.draw();
      } else if (k === "c" && this.data.ticks) { this.clicked.forEach((one) => one.dot.remove()); this.clicked = []; this.spectra(); }
      else return false;
      return true;
    }
  }

  /** Views through the pupil, moved and added. */
  class Field extends Panel {
    constructor(data) {
      super(data);
      const [vr, vc, channels, rows, cols] = data.views.shape;
      Object.assign(this, { vr, vc, channels, rows, cols, slope: data.slopes[2], view: [vr >> 1, vc >> 1], plane: 0, pull: [0, 0] });
      const step = (this.step = data.step);
      this.layer = { low: 0, high: data.high, map: "light" };
      this.sums = new Float32Array(rows * step * cols * step); this.weights = this.sums.slice(); this.spare = this.sums.slice();
      this.made = new Float32Array(channels * this.sums.length);
      this.modes = {
        refocus: new Picture(rows * step, cols * step, { smooth: true }),
        views: new Picture(rows, cols),
      };
      if (data.planes) {
        this.modes.planes = new Picture(data.planes.shape[2], data.planes.shape[3], { smooth: true });
        const nearest = data.plane_slopes.map((s) => Math.abs(s - this.slope));
        this.plane = nearest.indexOf(Math.min(...nearest));
      }
      this.mode = data.planes && vr * vc < 25 ? "planes" : "refocus";
      const names = { refocus: "refocus", planes: "stored planes", views: "views" };
      this.buttons = Object.keys(names).filter((m) => this.modes[m]).map((m) => {
        const button = el("button", { textContent: names[m] });
        button.dataset.mode = m; button.addEventListener("click", () => this.to(m));
        return button;
      });
      this.focus = slider("focus", data.slopes[0], data.slopes[1], 0.02, this.slope, (v) => { this.slope = v; this.to("refocus"); });
      this.stored = slider("plane", 0, Math.max(0, data.plane_slopes.length - 1), 1, this.plane, (v) => { this.plane = v; this.to("planes"); });
      this.stored.box.hidden = !data.planes;
      this.lay(Object.values(this.modes).map((p) => p.box), [...this.buttons, this.focus.box, this.stored.box]);
      for (const picture of Object.values(this.modes)) {
        picture.listen({ hover: (r, c) => this.tell(r, c), click: (r, c) => this.pick(r / picture.rows, c / picture.cols), drag: (dx, dy) => this.drag(dx, dy) });
      }
      if (data.depth.length) this.addDepth();
      this.readout.textContent = "Drag the picture for another view" + (data.depth.length ? ", click the depth map to focus there." : ".");
    }
    addDepth() {
      const [, rows, cols] = this.data.depth[0].values.shape;
      this.map = new Picture(rows, cols, { most: 300 });
      this.shown = 0;
      const pick = choice("depth map", this.data.depth.map((l) => l.name), 0, (v) => { this.shown = v; this.draw(); });
      this.map.listen({ hover: (r, c) => this.depthAt(r, c), click: (r, c) => this.pick((r + 0.5) / rows, (c + 0.5) / cols) });
      this.side.append(el("div", { className: "controls" }, pick.box), this.map.box);
    }
    /** The picture of a plane: each value of a view is spread bilinearly where it meets the plane, then smoothed over a pitch. */
    refocus() {
      for (let channel = 0; channel < this.channels; channel++) this.made.set(this.focused(channel), channel * this.sums.length);
      return this.made;
    }
    focused(channel) {
      const { rows, cols, step, vr, vc, channels, sums, weights, data } = this, views = data.views.values;
      const R = rows * step, C = cols * step;
      sums.fill(0); weights.fill(0);
      for (let i = 0; i < vr; i++) {
        const down = this.slope * data.places[0][i] * step, d0 = Math.floor(down), fd = down - d0;
        for (let j = 0; j < vc; j++) {
          const across = this.slope * data.places[1][j] * step, a0 = Math.floor(across), fa = across - a0;
          const w = [(1 - fd) * (1 - fa), (1 - fd) * fa, fd * (1 - fa), fd * fa];
          for (let k = 0; k < 4; k++) {
            const share = w[k], dr = d0 + (k >> 1), dc = a0 + (k & 1);
            if (!share) continue;
            const first = Math.max(0, Math.ceil(-dc / step)), last = Math.min(cols - 1, Math.floor((C - 1 - dc) / step));
            for (let r = 0; r < rows; r++) {
              const row = r * step + dr;
              if (row < 0 || row >= R) continue;
              let from = (((i * vc + j) * channels + channel) * rows + r) * cols + first, to = row * C + first * step + dc;
              for (let c = first; c <= last; c++, from++, to += step) {
                const v = views[from];
                if (v === v) { sums[to] += share * v; weights[to] += share; }
              }
            }
          }
        }
      }
      this.tent(sums, R, C); this.tent(weights, R, C);
      let top = 0;
      for (let i = 0; i < weights.length; i++) if (weights[i] > top) top = weights[i];
      for (let i = 0; i < sums.length; i++) sums[i] = weights[i] > 0.02 * top ? sums[i] / weights[i] : NaN;
      return sums;
    }
    /** Smooths by a tent of `step` points each way, along rows, then along columns. */
    tent(values, R, C) {
      const { step, spare } = this;
      if (step === 1) return;
      spare.fill(0);
      for (let o = 1 - step; o < step; o++) {
        const w = 1 - Math.abs(o) / step, from = Math.max(0, -o), to = Math.min(C, C - o);
        for (let r = 0; r < R; r++) for (let c = from, i = r * C + from; c < to; c++, i++) spare[i] += w * values[i + o];
      }
      values.fill(0);
      for (let o = 1 - step; o < step; o++) {
        const w = 1 - Math.abs(o) / step, from = Math.max(0, -o) * C, to = Math.min(R, R - o) * C;
        for (let i = from; i < to; i++) values[i] += w * spare[i + o * C];
      }
    }
    /** Where the first channel of what is shown begins. */
    start() {
      const picture = this.modes[this.mode], number = { refocus: 0, planes: this.plane, views: this.view[0] * this.vc + this.view[1] }[this.mode];
      return number * this.channels * picture.rows * picture.cols;
    }
    draw() {
      const { data, mode } = this, picture = this.modes[mode];
      for (const [name, one] of Object.entries(this.modes)) one.box.hidden = name !== mode;
      for (const button of this.buttons) button.setAttribute("aria-pressed", button.dataset.mode === mode);
      const values = mode === "refocus" ? this.refocus() : mode === "planes" ? data.planes.values : data.views.values;
      if (data.to_rgb.length) picture.paintChannels(values, this.start(), data.to_rgb, data.high, this.gain);
      else picture.paint(values, this.start(), this.layer, this.gain);
      picture.show();
      this.focus.text.textContent = mode === "views" ? `view (${this.view.join(", ")}) of ${this.vr} × ${this.vc}` : `slope ${this.slope.toFixed(2)}`;
      this.stored.text.textContent = data.plane_labels[this.plane] || "";
      if (this.map) {
        const layer = data.depth[this.shown];
        this.map.paint(layer.values.values, 0, layer, 1); this.map.show();
      }
    }
    to(mode) { if (this.modes[mode]) { this.mode = mode; this.draw(); } }
    drag(dx, dy) {
      this.pull = [this.pull[0] + dy, this.pull[1] + dx];
      const counts = [this.vr, this.vc], reach = 0.6;
      this.pull.forEach((share, axis) => {
        const whole = Math.trunc(share * counts[axis] / reach);
        if (whole) { this.view[axis] = clamp(this.view[axis] + whole, 0, counts[axis] - 1); this.pull[axis] -= whole * reach / counts[axis]; }
      });
      this.to("views");
    }
    pick(row, col) {
      const slope = this.data.depth[0];
      if (!slope) return;
      const [, rows, cols] = slope.values.shape, r = Math.min(rows - 1, Math.floor(row * rows)), c = Math.min(cols - 1, Math.floor(col * cols));
      const found = slope.values.values[r * cols + c];
      this.depthAt(r, c);
      if (Number.isNaN(found)) return;
      this.slope = clamp(found, this.data.slopes[0], this.data.slopes[1]); this.focus.input.value = this.slope;
      const gaps = this.data.plane_slopes.map((s) => Math.abs(s - found));
      if (gaps.length) this.stored.input.value = this.plane = gaps.indexOf(Math.min(...gaps));
      this.to(this.mode === "views" ? "refocus" : this.mode);
    }
    depthAt(r, c) {
      const cols = this.map.cols;
      this.readout.textContent = `lenslet pitch (${r}, ${c}): ` + this.data.depth.map((l) => `${l.name} ${told(l.values.values[r * cols + c])} ${l.unit}`).join(" · ");
    }
    tell(r, c) {
      const { mode, data } = this, picture = this.modes[mode];
      const values = mode === "refocus" ? this.made : mode === "planes" ? data.planes.values : data.views.values;
      const found = [...Array(this.channels).keys()].map((k) => told(values[this.start() + (k * picture.rows + r) * picture.cols + c]));
      this.readout.textContent = `row ${r}, column ${c}: ${found.map((v, k) => (data.channels[k] ? data.channels[k] + " " : "") + v).join(" · ")}`;
    }
    key(k) {
      const turn = { w: [-1, 0], s: [1, 0], a: [0, -1], d: [0, 1] }[k], mode = { f: "refocus", p: "planes", v: "views" }[k];
      if (k === "ArrowLeft" || k === "ArrowRight") (this.mode === "planes" ? this.stored : this.focus).move((k === "ArrowLeft" ? -1 : 1) * (this.mode === "planes" ? 1 : 5));
      else if (turn) { this.view = this.view.map((v, i) => clamp(v + turn[i], 0, [this.vr, this.vc][i] - 1)); this.to("views"); }
      else if (mode) this.to(mode);
      else return false;
      return true;
    }
  }

  /** Three slices through one voxel, each layer in a column of its own. */
  class Volume extends Panel {
    constructor(data) {
      super(data);
      const [planes, rows, cols] = data.layers[0].values.shape, [dz, dy, dx] = data.sizes;
      this.shape = [planes, rows, cols];
      this.place = this.shape.map((n) => n >> 1);
      // deep volumes would be needles: a plane is drawn at most 8 pixels high
      const thick = clamp(dz / dx, 0.25, 8);
      const wide = cols * dx, high = rows * dy, widest = Math.max(wide, high);
      const kinds = [
        { name: "xy", rows: 1, cols: 2, aspect: dy / dx, width: wide },
        { name: "xz", rows: 0, cols: 2, aspect: thick, width: wide },
        { name: "yz", rows: 0, cols: 1, aspect: thick * dx / dy, width: high },
      ];
      this.sets = data.layers.map((layer) => {
        const slices = kinds.map((kind) => {
          const picture = new Picture(this.shape[kind.rows], this.shape[kind.cols], { aspect: kind.aspect });
          picture.box.style.maxWidth = `${100 * kind.width / widest}%`;
          const lines = [el("i", { className: "cross" }), el("i", { className: "cross" })];
          picture.box.append(...lines, el("span", { className: "tag left", textContent: kind.name }));
          const go = (r, c) => { this.place[kind.rows] = r; this.place[kind.cols] = c; this.draw(); };
          picture.listen({ click: go, hover: (r, c) => this.tell(kind, r, c) });
          return { kind, picture, lines, values: new Float32Array(picture.rows * picture.cols) };
        });
        return { layer, slices };
      });
      this.deep = slider("plane", 0, planes - 1, 1, this.place[0], (v) => { this.place[0] = v; this.draw(); });
      const columns = this.sets.map(({ layer, slices }) => el("div", {}, el("h3", { textContent: layer.name }), el("div", { className: "three" }, ...slices.map((s) => s.picture.box))));
      this.root.append(el("div", { className: "controls" }, this.deep.box), this.readout, el("div", { className: this.sets.length > 1 ? "slices" : "slices alone" }, ...columns));
    }
    value(layer, place) {
      const [, rows, cols] = this.shape;
      return layer.values.values[(place[0] * rows + place[1]) * cols + place[2]];
    }
    draw() {
      for (const { layer, slices } of this.sets) {
        for (const { kind, picture, lines, values } of slices) {
          const place = [...this.place];
          for (let r = 0, i = 0; r < picture.rows; r++) for (let c = 0; c < picture.cols; c++, i++) { place[kind.rows] = r; place[kind.cols] = c; values[i] = this.value(layer, place); }
          picture.paint(values, 0, layer, this.gain); picture.show();
          const y = (this.place[kind.rows] + 0.5) / picture.rows * 100, x = (this.place[kind.cols] + 0.5) / picture.cols * 100;
          lines[0].style.cssText = `left:0;right:0;height:1px;top:${y}%`; lines[1].style.cssText = `top:0;bottom:0;width:1px;left:${x}%`;
        }
      }
      this.deep.input.value = this.place[0]; this.deep.text.textContent = this.data.depths[this.place[0]];
      this.say(this.place);
    }
    say(place) {
      this.readout.textContent = `plane ${place[0]} at ${this.data.depths[place[0]]}, row ${place[1]}, column ${place[2]}: ` + this.data.layers.map((l) => `${l.name} ${told(this.value(l, place))}`).join(" · ");
    }
    tell(kind, r, c) { const place = [...this.place]; place[kind.rows] = r; place[kind.cols] = c; this.say(place); }
    key(k) {
      const move = { ArrowLeft: [2, -1], ArrowRight: [2, 1], ArrowUp: [1, -1], ArrowDown: [1, 1], ",": [0, -1], ".": [0, 1] }[k];
      if (!move) return false;
      this.place[move[0]] = clamp(this.place[move[0]] + move[1], 0, this.shape[move[0]] - 1);
      this.draw();
      return true;
    }
  }

  const KINDS = { stack: Stack, field: Field, volume: Volume };

  async function begin() {
    const content = JSON.parse(document.getElementById("content").textContent);
    const tabs = document.getElementById("tabs"), main = document.getElementById("panels"), keys = document.getElementById("keys");
    const made = content.map(() => null);
    let at = -1;
    async function open(number) {
      at = number;
      [...tabs.children].forEach((tab, i) => tab.setAttribute("aria-selected", i === number));
      if (!made[number]) {
        const data = await unpackAll(content[number]);
        if (!made[number]) { made[number] = new KINDS[data.kind](data); main.append(made[number].root); }
      }
      made.forEach((panel, i) => { if (panel) panel.root.hidden = i !== at; });
      made[at].draw();
      document.documentElement.dataset.ready = at;
    }
    content.forEach((panel, i) => {
      const tab = el("button", { textContent: panel.title });
      tab.setAttribute("role", "tab");
      tab.addEventListener("click", () => open(i));
      tabs.append(tab);
    });
    tabs.hidden = content.length < 2;
    const theme = () => {
      const root = document.documentElement, dark = matchMedia("(prefers-color-scheme: dark)").matches;
      root.dataset.theme = (root.dataset.theme || (dark ? "dark" : "light")) === "dark" ? "light" : "dark";
    };
    document.getElementById("theme").addEventListener("click", theme);
    document.getElementById("help").addEventListener("click", () => keys.showModal());
    addEventListener("keydown", (e) => {
      if (e.ctrlKey || e.metaKey || e.altKey || keys.open || e.target.tagName === "SELECT") return;
      const k = e.key, panel = made[at];
      if (k === "?") keys.showModal();
      else if (k === "t") theme();
      else if (k === "[" || k === "]") open((at + (k === "]" ? 1 : -1) + content.length) % content.length);
      else if (panel && (k === "+" || k === "=")) panel.brighter(1.25);
      else if (panel && k === "-") panel.brighter(0.8);
      else if (!panel || !panel.key(k)) return;
      e.preventDefault();
    });
    // #p3 is the fourth panel
    const asked = () => { const n = Number(/^#p(\d+)$/.exec(location.hash)?.[1] ?? 0); return n < content.length ? n : 0; };
    addEventListener("hashchange", () => open(asked()));
    await open(asked());
  }
  begin();
})();
