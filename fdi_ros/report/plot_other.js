// Copyright 2026 fdi_ros maintainers
// SPDX-License-Identifier: Apache-2.0

// Plots without two number axes: a table of shades, and axes in space.

const CIVIDIS = [[0, 34, 78], [53, 69, 108], [102, 105, 112], [148, 142, 119], [200, 184, 102], [254, 232, 56]];
const shade = (share) => {
  const place = Math.min(Math.max(share, 0), 1) * (CIVIDIS.length - 1), k = Math.min(Math.floor(place), CIVIDIS.length - 2);
  return CIVIDIS[k].map((v, i) => Math.round(v + (place - k) * (CIVIDIS[k + 1][i] - v)));
};

class Heat {
  constructor(figure, element) {
    this.trace = figure.data[0];
    this.stage = element.querySelector(".stage");
    this.stage.removeAttribute("tabindex");
    this.stage.setAttribute("role", "img");
    this.stage.setAttribute("aria-label", `${figure.layout?.title ?? "Table of shades"}: the table beside it has the figures.`);
  }

  draw(width = this.stage.clientWidth) {
    if (!width) return;
    const { z, x, y } = this.trace;
    const left = Math.max(...y.map((name) => name.length)) * LETTER + 10;
    const side = Math.min((width - left - 4) / x.length, 52), upright = Math.max(...x.map((name) => name.length)) * LETTER > side;
    const top = upright ? Math.max(...x.map((name) => name.length)) * LETTER + 10 : 20, height = top + side * y.length + 6;
    const parts = [`<svg width="${width}" height="${px(height)}" viewBox="0 0 ${width} ${px(height)}" aria-hidden="true">`];
    x.forEach((name, j) => {
      const at = left + (j + 0.5) * side;
      parts.push(`<text class="tick" ${upright ? `transform="translate(${px(at + 4)},${top - 5}) rotate(-90)"` : `x="${px(at)}" y="14" text-anchor="middle"`}>${esc(name)}</text>`);
    });
    z.forEach((row, i) => {
      const at = top + i * side;
      parts.push(`<text class="tick" x="${left - 6}" y="${px(at + side / 2 + 4)}" text-anchor="end">${esc(y[i])}</text>`);
      row.forEach((value, j) => {
        const [r, g, b] = shade(value), dark = 0.3 * r + 0.6 * g + 0.1 * b < 128;
        parts.push(`<g><title>${esc(`${y[i]}, ${x[j]}: ${short(value)}`)}</title><rect x="${px(left + j * side)}" y="${px(at)}" width="${px(side - 1)}" height="${px(side - 1)}" fill="rgb(${r},${g},${b})"/>`);
        if (side > 30) parts.push(`<text x="${px(left + (j + 0.5) * side)}" y="${px(at + side / 2 + 4)}" text-anchor="middle" font-size="11" fill="${dark ? "#fff" : "#000"}">${value.toFixed(2)}</text>`);
        parts.push("</g>");
      });
    });
    this.stage.innerHTML = `${parts.join("")}</svg>`;
  }
}

class Space { // arrows from the origin, turned by a drag or the arrow keys
  constructor(figure, element) {
    Object.assign(this, { traces: figure.data, layout: figure.layout ?? {}, yaw: 0.6, pitch: 0.45 });
    this.stage = element.querySelector(".stage");
    this.stage.setAttribute("role", "group");
    const ends = this.traces.filter((t) => t.name).map((t) => `${t.name} ${t.x.at(-1)} ${t.y.at(-1)} ${t.z.at(-1)}`);
    this.stage.setAttribute("aria-label", `Axes in the body frame, x y z: ${ends.join("; ")}. Arrow keys turn the view.`);
    let from = null;
    this.stage.addEventListener("pointerdown", (event) => {
      from = [event.clientX, event.clientY];
      this.stage.setPointerCapture(event.pointerId);
    });
    this.stage.addEventListener("pointermove", (event) => {
      if (!from) return;
      this.turn((event.clientX - from[0]) * 0.01, (event.clientY - from[1]) * 0.01);
      from = [event.clientX, event.clientY];
    });
    for (const name of ["pointerup", "pointercancel"]) this.stage.addEventListener(name, () => { from = null; });
    this.stage.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
      if (!by) return;
      event.preventDefault();
      this.turn(...by);
    });
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(Math.max(this.pitch + pitch, -1.5), 1.5);
    this.draw();
  }

  draw(width = this.stage.clientWidth) {
    if (!width) return;
    const side = Math.min(width, this.layout.height ?? 520), unit = side / 2.9, middle = [width / 2, side / 2];
    const [c, s, d, e] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    const seen = (x, y, z) => { // z of the body is up; depth grows towards the eye
      const across = -s * x + c * y, along = c * x + s * y;
      return [middle[0] + unit * across, middle[1] - unit * (d * z - e * along), d * along + e * z];
    };
    const arrows = this.traces.map((t) => ({ t, from: seen(t.x[0], t.y[0], t.z[0]), to: seen(t.x.at(-1), t.y.at(-1), t.z.at(-1)) }));
    arrows.sort((a, b) => a.to[2] - b.to[2]);
    const taken = [], parts = [`<svg width="${width}" height="${side}" viewBox="0 0 ${width} ${side}" aria-hidden="true">`];
    for (const { t, from, to } of arrows) {
      const colour = t.name ? t.line.color : "var(--dim)", dash = t.line?.dash ? ' stroke-dasharray="6 4"' : "";
      parts.push(`<line x1="${px(from[0])}" y1="${px(from[1])}" x2="${px(to[0])}" y2="${px(to[1])}" stroke="${colour}" stroke-width="${t.name ? 3.5 : 1.5}" stroke-linecap="round"${dash}/>`);
      if (t.name) parts.push(`<circle cx="${px(to[0])}" cy="${px(to[1])}" r="4.5" fill="${colour}"/>`);
    }
    for (const { t, to } of arrows.reverse()) { // names of parallel axes below each other
      const label = t.text?.at(-1) ?? t.name ?? "", size = label.length * LETTER;
      const x = to[0] + 8 + size > width ? to[0] - 8 - size : to[0] + 8;
      let y = to[1] + 4;
      while (taken.some((o) => Math.abs(o.y - y) < 14 && x < o.x + o.size + 4 && o.x < x + size + 4)) y += 14;
      taken.push({ x, y, size });
      parts.push(`<text class="${t.name ? "name" : "tick"}" x="${px(x)}" y="${px(y)}">${esc(label)}</text>`);
    }
    this.stage.innerHTML = `${parts.join("")}</svg>`;
  }
}
