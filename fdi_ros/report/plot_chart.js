// Copyright 2026 fdi_ros maintainers
// SPDX-License-Identifier: Apache-2.0

// One plot with two axes: curves, bands, spans in rows; marks, a cursor, a zoom.

const DASHES = { dash: "7 4", dot: "2 3", dashdot: "8 3 2 3" };
const GLYPHS = { detected: "M-5,-9h10l-5,8z", isolated: "M0,2l5,5l-5,5l-5,-5z", declared: "M-4,-9l8,8M4,-9l-8,8", autopilot: "M-3,-7h6v6h-6z" };
const LETTER = 6.6; // px, about, of the small print
const BUTTONS = 96; // px, width of the buttons that save a plot, at its upper right

const esc = (text) => String(text).replace(/[&<>"']/g, (c) => `&#${c.charCodeAt(0)};`);
const px = (value) => value.toFixed(1);
const utc = (seconds, length) => {
  if (!page.origin) return "";
  return new Date(page.origin + 1000 * seconds).toISOString().slice(0, length).replace("T", " ");
};
const keyOf = (trace) => trace.legendgroup ?? trace.name ?? "";

class Chart {
  constructor(figure, element, section, link) {
    Object.assign(this, { layout: figure.layout ?? {}, element, section, link });
    this.traces = figure.data.map((trace) => ({ ...trace, curve: curveOf(trace), colour: trace.line.color, key: keyOf(trace) }));
    this.rows = this.layout.rows;
    this.stage = element.querySelector(".stage");
    this.readout = document.createElement("div");
    this.readout.className = "readout";
    this.readout.setAttribute("role", "status");
    this.stage.after(this.readout);
    this.stage.setAttribute("role", "group");
    this.stage.setAttribute("aria-label", this.words());
    this.listen();
    link.charts.push(this);
    addSaving(this);
  }

  get shown() { return this.traces.filter((trace) => !this.section.hidden.has(trace.key)); }

  get lines() { return this.shown.filter((t) => t.type === "scatter" || (t.type === "band" && !t.packed)); }

  words() {
    const named = (t) => {
      const [[low, high] = []] = columns([t.curve], [-Infinity, Infinity].map((v) => (v < 0 ? t.curve.x[0] : t.curve.x[t.curve.x.length - 1])), 1);
      return low === undefined ? null : `${t.name} ${short(low)} to ${short(high)}`;
    };
    const said = this.rows ? this.traces.map((t) => t.name)
      : this.traces.filter((t) => t.type === "scatter" && t.name).slice(0, 14).map(named).filter(Boolean);
    const marks = (this.layout.marks ?? []).slice(0, 12).map((m) => m.text);
    return `${this.title}: ${[...said, ...marks].join("; ")}. Arrow keys move the cursor, plus and minus zoom, 0 shows everything.`;
  }

  get title() { return [this.layout.title, this.layout.yaxis?.title?.text].filter(Boolean).join(", "); }

  whole() { // range of x of all that there is
    if (this.layout.xaxis?.range) return this.layout.xaxis.range;
    let low = Infinity, high = -Infinity;
    for (const { curve } of this.traces) {
      for (const value of [curve.x[0], curve.x[curve.x.length - 1], ...(curve.x.length < 500 ? curve.x : [])]) {
        if (value < low) low = value;
        if (value > high) high = value;
      }
    }
    // Marks at the ends of a curve are not cut in halves; a time has no room around it.
    return low < high && this.layout.link ? [low, high] : padded([low, high], this.layout.xaxis?.type);
  }

  values() { // range of y that this plot asks for
    if (this.rows || this.layout.yaxis?.range) return null;
    let curves = this.lines.map((trace) => trace.curve);
    if (this.layout.yaxis?.type === "log") {
      const positive = (values) => Array.from(values, (v) => (v > 0 ? v : NaN));
      curves = curves.map((c) => ({ x: c.x, low: positive(c.low), high: positive(c.high) }));
    }
    return valueRange(curves, this.link.range, this.layout.needed ?? []);
  }

  draw(width = this.stage.clientWidth) {
    if (!width) return;
    const { layout } = this, kind = layout.yaxis?.type ?? "linear";
    const height = layout.height ?? 240, bottom = layout.xaxis?.hidden ? 6 : layout.xaxis?.title ? 36 : 24;
    const longest = this.rows ? Math.max(...this.rows.map((row) => row.length)) * LETTER + 8 : 54;
    const left = Math.min(Math.max(54, longest), 0.4 * width), right = width - 12, top = 22;
    Object.assign(this, { width, height });
    this.x = scaleOf(layout.xaxis?.type ?? "linear", this.link.range, [left, right], Math.max(2, (right - left) / 80));
    const base = height - bottom;
    if (this.rows) {
      this.y = scaleOf("linear", [0, this.rows.length], [top, base], 1);
      this.y.ticks = this.rows.map((name, k) => [k + 0.5, name]);
    } else {
      const range = this.yRange(kind);
      this.y = scaleOf(kind, range, [base, top], Math.max(2, (base - top) / 30));
    }
    const clip = `clip${this.layout.number}`;
    const parts = [
      `<svg width="${width}" height="${height}" viewBox="0 0 ${width} ${height}" aria-hidden="true">`,
      `<clipPath id="${clip}"><rect x="${left}" y="${top}" width="${px(right - left)}" height="${px(base - top)}"/></clipPath>`,
      this.grid(left, right, top, base), `<g clip-path="url(#${clip})">`, this.shapes(top, base), this.backdrop(top, base),
      ...this.shown.map((trace) => this.trace(trace)), "</g>", this.marks(top, base), this.labels(top), this.head(left, right),
      '<line class="cursor" y1="22" y2="' + base + '" hidden/></svg>',
    ];
    this.stage.innerHTML = parts.join("");
    this.line = this.stage.querySelector(".cursor");
    this.point(this.link.cursor);
  }

  yRange(kind) {
    if (this.layout.yaxis?.range) { this.cut = null; return this.layout.yaxis.range; }
    const group = this.layout.scale;
    const asked = group ? together(this.link.charts.filter((c) => c.layout.scale === group).map((c) => c.values())) : this.values();
    this.cut = null;
    if (!asked) return padded([1, 0], kind);
    // Chance dips towards zero are no part of a logarithmic picture.
    if (kind === "log" && asked.floor > 0 && this.layout.link) return padded([asked.floor, asked.all[1]], kind);
    const span = ([low, high]) => high - low;
    const far = this.layout.robust && kind !== "log" && span(asked.all) > WIDE * span(asked.usual) && span(asked.usual) > 0;
    if (far) this.section.far = true;
    if (!far || this.section.full) return padded(asked.all, kind);
    this.cut = this.values()?.all;
    return padded(asked.usual, kind);
  }

  grid(left, right, top, base) {
    const parts = [];
    for (const [value, label] of this.y.ticks) {
      const at = px(this.y.to(value));
      if (!this.rows) parts.push(`<line class="grid" x1="${left}" x2="${right}" y1="${at}" y2="${at}"/>`);
      parts.push(`<text class="tick" x="${left - 6}" y="${at}" dy="4" text-anchor="end">${esc(label)}</text>`);
    }
    for (const [value, label] of this.x.ticks) {
      const at = px(this.x.to(value));
      parts.push(`<line class="grid" x1="${at}" x2="${at}" y1="${top}" y2="${base}"/>`);
      if (!this.layout.xaxis?.hidden) parts.push(`<text class="tick" x="${at}" y="${base + 15}" text-anchor="${+at > right - 14 ? "end" : "middle"}">${esc(label)}</text>`);
    }
    const since = this.layout.link === "time" && utc(0, 19), named = this.layout.xaxis?.title?.text;
    const title = since && (named.length + since.length + 12) * LETTER < right - left ? `${named}; 0 is ${since} UTC` : named;
    if (title && !this.layout.xaxis?.hidden) parts.push(`<text class="tick" x="${px((left + right) / 2)}" y="${px(base + 31)}" text-anchor="middle">${esc(title)}</text>`);
    parts.push(`<rect class="frame" x="${left}" y="${top}" width="${px(right - left)}" height="${px(base - top)}"/>`);
    return parts.join("");
  }

  shapes(top, base) {
    const [left, right] = this.x.pixels;
    return (this.layout.shapes ?? []).map((shape) => {
      const from = this.x.to(shape.x0), to = this.x.to(shape.x1 ?? this.x.range[1]);
      const begin = Math.max(from, left) + 3, label = shape.label ?? "";
      const words = label && Math.min(to, right) - begin > label.length * LETTER
        ? `<text class="tick" x="${px(begin)}" y="${px(base - 5)}">${esc(label)}</text>` : "";
      return `<rect class="${shape.kind}" x="${px(from)}" y="${top}" width="${px(Math.max(to - from, 0.5))}" height="${px(base - top)}"/>${words}`;
    }).join("");
  }

  backdrop(top, base) { // a share from 0 to 1 over the height of the plot
    const { x, y } = this.layout.backdrop ?? { x: [], y: [] };
    if (x.length < 2) return "";
    const path = points({ x, low: y, high: y }, this.link.range, this.x.pixels[1] - this.x.pixels[0])
      .filter(([, share]) => Number.isFinite(share)).map(([at, share]) => `${px(this.x.to(at))},${px(base - share * (base - top))}`);
    if (!path.length) return "";
    return `<path class="backdrop" d="M${path[0].split(",")[0]},${base}L${path.join("L")}L${path[path.length - 1].split(",")[0]},${base}Z"/>`;
  }

  trace(trace) {
    if (trace.type === "spans") return this.spans(trace);
    const most = Math.max(200, (this.x.pixels[1] - this.x.pixels[0]) / 1.5);
    const path = (list) => {
      let pen = "M";
      return list.map(([a, b]) => {
        if (!Number.isFinite(b) || (this.y.kind === "log" && b <= 0)) { pen = "M"; return ""; }
        const at = Math.min(Math.max(this.y.to(b), -1e4), 1e4), text = `${pen}${px(this.x.to(a))},${px(at)}`;
        pen = "L";
        return text;
      }).join("");
    };
    if (trace.type === "band") {
      const { x, low, high } = trace.curve;
      const finite = (list) => list.filter(([, v]) => Number.isFinite(v));
      const upper = finite(points({ x, low: high, high }, this.link.range, most / 4));
      const lower = finite(points({ x, low, high: low }, this.link.range, most / 4)).reverse();
      return `<path class="band" fill="${trace.colour}" d="${path([...upper, ...lower])}Z"/>`;
    }
    const list = points(trace.curve, this.link.range, most), mode = trace.mode ?? "lines";
    const dash = DASHES[trace.line?.dash] ? ` stroke-dasharray="${DASHES[trace.line.dash]}"` : "";
    const line = mode.includes("lines") ? `<path class="line" stroke="${trace.colour}" stroke-width="${trace.line?.width ?? 1.6}"${dash} d="${path(list)}"/>` : "";
    if (!mode.includes("markers")) return line;
    const dots = list.filter(([, b]) => Number.isFinite(b) && (this.y.kind !== "log" || b > 0));
    return line + dots.map(([a, b]) => `<circle r="3" fill="${trace.colour}" cx="${px(this.x.to(a))}" cy="${px(this.y.to(b))}"/>`).join("");
  }

  spans(trace) {
    const tall = Math.abs(this.y.to(1) - this.y.to(0));
    return trace.row.map((row, i) => {
      const from = Math.max(this.x.to(trace.from[i]), this.x.pixels[0] - 2), to = Math.min(this.x.to(trace.to[i]), this.x.pixels[1] + 2);
      if (to < from) return "";
      const box = `x="${px(from)}" y="${px(this.y.to(row) + 0.12 * tall)}" width="${px(Math.max(to - from, 1))}" height="${px(0.76 * tall)}"`;
      const shade = trace.pattern ? `<rect ${box} fill="url(#${trace.pattern})"/>` : "";
      return `<g><title>${esc(trace.text[i])}</title><rect ${box} fill="${trace.colour}"/>${shade}</g>`;
    }).join("");
  }

  // What a mark stands for, beside it, as far as there is room; the readout and the words for a screen reader have all.
  labels(top) {
    const rows = [];
    return (this.layout.marks ?? []).map((mark) => {
      const at = this.x.to(mark.x);
      if (!mark.label || at < this.x.pixels[0] - 1 || at > this.x.pixels[1] + 1) return "";
      const wide = mark.label.length * LETTER, left = at + 8 + wide > this.x.pixels[1], from = left ? at - 8 - wide : at + 8;
      const row = [0, 1, 2].find((k) => !(rows[k] ?? []).some(([a, b]) => from < b && from + wide > a));
      if (row === undefined || from < this.x.pixels[0]) return "";
      (rows[row] ??= []).push([from, from + wide]);
      return `<text class="tick said" x="${px(left ? at - 8 : at + 8)}" y="${top + 14 + 15 * row}" text-anchor="${left ? "end" : "start"}">${esc(mark.label)}</text>`;
    }).join("");
  }

  marks(top, base) {
    return (this.layout.marks ?? []).map((mark) => {
      const at = this.x.to(mark.x);
      if (at < this.x.pixels[0] - 1 || at > this.x.pixels[1] + 1) return "";
      const glyph = GLYPHS[mark.kind] ? `<path d="${GLYPHS[mark.kind]}" transform="translate(${px(at)},${top})"/>` : "";
      return `<g class="mark ${mark.kind}"><title>${esc(mark.text)}</title><line x1="${px(at)}" x2="${px(at)}" y1="${top}" y2="${base}"/>${glyph}</g>`;
    }).join("");
  }

  head(left, right) {
    const far = this.cut && (this.cut[0] < this.y.range[0] || this.cut[1] > this.y.range[1]);
    const note = far ? `all: ${short(this.cut[0])} to ${short(this.cut[1])}` : "";
    const end = right - BUTTONS;
    const room = Math.floor((end - 4) / LETTER) - (note ? note.length + 2 : 0);
    const title = this.title.length > room ? `${this.title.slice(0, Math.max(room - 1, 8))}…` : this.title;
    return `<text class="name" x="4" y="12">${esc(title)}</text>`
      + (note ? `<text class="cut" x="${px(end)}" y="12" text-anchor="end">${esc(note)}</text>` : "");
  }

  point(value) { // the cursor of this plot and of those linked to it
    if (!this.line) return;
    const none = value === null || value === undefined || value < this.x.range[0] || value > this.x.range[1];
    this.line.toggleAttribute("hidden", none);
    this.readout.hidden = none;
    if (none) return;
    const at = px(this.x.to(value));
    this.line.setAttribute("x1", at);
    this.line.setAttribute("x2", at);
    const own = this.link.over === this;
    const side = at > (this.x.pixels[0] + this.x.pixels[1]) / 2;
    this.readout.style.left = side ? `${this.x.pixels[0] + 4}px` : "auto";
    this.readout.style.right = side ? "auto" : "14px";
    this.readout.innerHTML = this.rows ? this.spanWords(value, own) : this.valueWords(value, own);
  }

  valueWords(value, own) {
    const named = this.lines.filter((t) => t.type === "scatter" && t.name && t.curve.x.length)
      .sort((a, b) => (a.rank ?? 0) - (b.rank ?? 0));
    const said = named.slice(0, own ? 14 : 1).map((t) => {
      const i = nearest(t.curve.x, value), low = t.curve.low[i], high = t.curve.high[i];
      const words = low === high || !Number.isFinite(low) ? short(low) : `${short(low)} … ${short(high)}`;
      return `<span><i style="background:${t.colour}"></i>${esc(t.name)} ${words}</span>`;
    });
    return (own ? `<b>${this.place(value)}</b> ` : "") + said.join(" ");
  }

  spanWords(value, own) {
    if (!own) return "";
    const said = this.rows.map((name, row) => {
      for (const t of this.shown) {
        const i = t.row?.findIndex((r, k) => r === row && t.from[k] <= value && value <= t.to[k]) ?? -1;
        if (i >= 0) return `<span><i style="background:${t.colour}"></i>${esc(name)} ${esc(t.name)}</span>`;
      }
      return "";
    });
    return `<b>${this.place(value)}</b> ${said.join(" ")}`;
  }

  place(value) {
    if (this.layout.link !== "time") return short(value);
    return `${value.toFixed(3)} s${page.origin ? `, ${utc(value, 23).slice(11)} UTC` : ""}`;
  }

  listen() {
    const { stage, link } = this;
    const at = (event) => {
      const pixel = event.clientX - stage.getBoundingClientRect().left, [from, to] = this.x.pixels;
      return this.x.back(Math.min(Math.max(pixel, from), to));
    };
    let from = null;
    stage.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      from = at(event);
      link.over = this;
      link.point(from);
      if (event.pointerType === "mouse") stage.setPointerCapture(event.pointerId);
    });
    stage.addEventListener("pointermove", (event) => {
      link.over = this;
      link.point(at(event));
      if (from !== null) this.select(from, at(event));
    });
    stage.addEventListener("pointerup", (event) => {
      if (from === null) return;
      const [a, b] = [from, at(event)].sort((p, q) => p - q);
      from = null;
      this.select(0, 0);
      if (Math.abs(this.x.to(b) - this.x.to(a)) > 6) link.zoom([a, b]);
    });
    stage.addEventListener("pointercancel", () => { from = null; this.select(0, 0); });
    // A finger leaves with every tap: what it pointed at stays.
    stage.addEventListener("pointerleave", (event) => { if (from === null && event.pointerType !== "touch") link.point(null); });
    stage.addEventListener("dblclick", () => link.zoom(null));
    stage.addEventListener("keydown", (event) => this.key(event));
    stage.addEventListener("blur", () => link.point(null));
  }

  select(a, b) {
    let box = this.stage.querySelector(".select");
    if (a === b) { box?.remove(); return; }
    if (!box) {
      box = document.createElement("div");
      box.className = "select";
      this.stage.append(box);
    }
    const [from, to] = [this.x.to(a), this.x.to(b)].sort((p, q) => p - q);
    Object.assign(box.style, { left: `${from}px`, width: `${to - from}px` });
  }

  key(event) {
    const { link } = this, [from, to] = this.x.pixels;
    const place = link.cursor === null ? (from + to) / 2 : this.x.to(link.cursor);
    const step = (event.shiftKey ? 0.1 : 0.01) * (to - from);
    const moved = { ArrowLeft: place - step, ArrowRight: place + step, Home: from, End: to }[event.key];
    const zoomed = { "+": 0.5, "=": 0.5, "-": 2, _: 2 }[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    link.over = this;
    if (moved !== undefined) link.point(this.x.back(Math.min(Math.max(moved, from), to)));
    else if (zoomed) link.zoom([from, to].map((end) => this.x.back(place + zoomed * (end - place))));
    else if (event.key === "0" || event.key === "Escape") link.zoom(null);
    else return;
    event.preventDefault();
  }
}
