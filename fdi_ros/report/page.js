// Copyright 2026 fdi_ros maintainers
// SPDX-License-Identifier: Apache-2.0

// The page: plots into their places, legends and switches, links between plots, theme, paper.

const PAPER = 690; // px across an A4 page between its margins

class Link { // plots that share a range of x and a cursor
  constructor() { Object.assign(this, { charts: [], cursor: null, over: null, range: null }); }

  start() {
    const spans = this.charts.map((chart) => chart.whole());
    this.all = [Math.min(...spans.map((s) => s[0])), Math.max(...spans.map((s) => s[1]))];
    this.range = this.all;
  }

  zoom(range) {
    const [low, high] = this.all;
    const inside = range ? [Math.max(range[0], low), Math.min(range[1], high)] : this.all;
    if (!(inside[0] < inside[1])) return;
    this.range = inside;
    if (this === links.time) history.replaceState(null, "", `${location.href.split("#")[0]}${range ? `#t=${inside.map((v) => +v.toFixed(3)).join(",")}` : ""}`);
    for (const section of new Set(this.charts.map((chart) => chart.section))) section.draw();
  }

  point(value) {
    this.cursor = value;
    for (const chart of this.charts) chart.point(value);
  }
}

class Section {
  constructor(element) {
    Object.assign(this, { element, plots: [], hidden: new Set(), full: false, far: false });
    this.bar = element.querySelector(".legend");
  }

  legend() {
    const items = new Map();
    for (const plot of this.plots) {
      for (const trace of plot instanceof Chart ? plot.traces : []) {
        if (trace.showlegend === false || !trace.name || items.has(trace.key)) continue;
        items.set(trace.key, trace);
      }
    }
    if (items.size > 1) {
      for (const [key, trace] of [...items].sort(([, a], [, b]) => (a.rank ?? 0) - (b.rank ?? 0))) {
        const button = this.button(trace.name, () => {
          if (this.hidden.delete(key)) button.setAttribute("aria-pressed", "true");
          else { this.hidden.add(key); button.setAttribute("aria-pressed", "false"); }
          this.draw();
        });
        button.setAttribute("aria-pressed", "true");
        const swatch = document.createElement("i");
        swatch.style.borderColor = trace.colour;
        swatch.className = trace.line?.dash ? trace.line.dash : "solid";
        button.prepend(swatch);
      }
    }
    this.scale = this.button("", () => { this.full = !this.full; this.draw(); });
    this.back = this.button("show everything", () => this.plots.find((plot) => plot instanceof Chart).link.zoom(null));
    this.scale.hidden = this.back.hidden = true;
  }

  button(words, act) {
    const button = document.createElement("button");
    Object.assign(button, { type: "button", textContent: words, onclick: act });
    this.bar.append(button);
    return button;
  }

  draw(width) {
    this.far = false;
    for (const plot of this.plots) plot.draw(width);
    this.scale.hidden = !this.far;
    this.scale.textContent = this.full ? "scale of most of the time" : "full scale";
    this.back.hidden = !this.plots.some((plot) => plot.link && plot.link.range !== plot.link.all);
  }
}

const sections = [], links = {};
for (const element of document.querySelectorAll("section.plots")) {
  const section = new Section(element);
  for (const place of element.querySelectorAll("figure")) {
    const figure = page.figures[+place.dataset.figure], kind = figure.data[0]?.type;
    figure.layout = { ...figure.layout, number: place.dataset.figure };
    if (kind === "heatmap") section.plots.push(new Heat(figure, place));
    else if (kind === "scatter3d") section.plots.push(new Space(figure, place));
    else section.plots.push(new Chart(figure, place, section, (links[figure.layout.link ?? `own ${place.dataset.figure}`] ??= new Link())));
  }
  sections.push(section);
}
for (const link of Object.values(links)) link.start();
for (const section of sections) { section.legend(); section.draw(); }

// A link with #t=FROM,TO shows this part of the time: that of the page once it is zoomed, and those of the episodes.
const follow = () => {
  const asked = /^#t=(-?[\d.]+),(-?[\d.]+)$/.exec(location.hash);
  if (asked) links.time?.zoom([+asked[1], +asked[2]]);
  return asked;
};
follow();
addEventListener("hashchange", () => { if (follow()) document.querySelector("section.plots").scrollIntoView(); });

let width = innerWidth;
const redraw = (at) => { for (const section of sections) section.draw(at); };
addEventListener("resize", () => {
  if (innerWidth === width) return; // the bar of a phone's browser comes and goes
  width = innerWidth;
  stackAll();
  redraw();
});
addEventListener("beforeprint", () => redraw(PAPER));
addEventListener("afterprint", () => redraw());

const root = document.documentElement, media = matchMedia("(prefers-color-scheme: dark)");
const paint = (dark) => root.classList.toggle("dark", dark);
paint(media.matches);
media.addEventListener("change", (event) => paint(event.matches));
document.getElementById("theme").addEventListener("click", () => paint(!root.classList.contains("dark")));
root.dataset.ready = "yes";
