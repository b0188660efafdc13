// Copyright 2026 fdi_ros maintainers
// SPDX-License-Identifier: Apache-2.0

// A plot as a picture (PNG) and its values as a table (CSV), of the part of the time that is shown.

const PIXELS = 2; // of the picture, per pixel of the page

const cell = (text) => (/[",\n]/.test(text) ? `"${text.replace(/"/g, '""')}"` : text);
const value = (number) => (Number.isFinite(number) ? String(number) : "");

const csvOf = (chart) => {
  const [from, to] = chart.link.range, rows = [];
  if (chart.rows) {
    for (const trace of chart.traces) {
      trace.row.forEach((row, k) => {
        if (trace.to[k] >= from && trace.from[k] <= to) rows.push([value(trace.from[k]), value(trace.to[k]), cell(chart.rows[row]), trace.name]);
      });
    }
    return ["from,to,name,state", ...rows.map((row) => row.join(","))].join("\n");
  }
  rows.push("series,x,low,high");
  for (const { name, curve, type } of chart.shown) {
    for (let k = 0; k < curve.x.length; k++) {
      if (curve.x[k] >= from && curve.x[k] <= to) rows.push([cell(name || type), value(curve.x[k]), value(curve.low[k]), value(curve.high[k])].join(","));
    }
  }
  return rows.join("\n");
};

// The styles of the page go into the picture, which has no page around it.
const pictureOf = async (chart) => {
  const svg = chart.stage.querySelector("svg").cloneNode(true), style = document.createElement("style");
  style.textContent = document.querySelector("style").textContent;
  svg.setAttribute("class", document.documentElement.className);
  svg.setAttribute("font-family", getComputedStyle(document.body).fontFamily);
  svg.prepend(style, document.querySelector("defs").cloneNode(true));
  const image = new Image();
  image.src = `data:image/svg+xml,${encodeURIComponent(new XMLSerializer().serializeToString(svg))}`;
  await image.decode();
  const canvas = document.createElement("canvas"), pen = canvas.getContext("2d");
  Object.assign(canvas, { width: PIXELS * chart.width, height: PIXELS * chart.height });
  pen.fillStyle = getComputedStyle(document.body).backgroundColor;
  pen.fillRect(0, 0, canvas.width, canvas.height);
  pen.drawImage(image, 0, 0, canvas.width, canvas.height);
  return canvas;
};

const saveAs = (blob, chart, suffix) => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = `${chart.title.replace(/[^A-Za-z0-9]+/g, "_").replace(/^_+|_+$/g, "") || "plot"}.${suffix}`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
};

const addSaving = (chart) => {
  const bar = document.createElement("div");
  bar.className = "save";
  const button = (words, about, act) => {
    const one = document.createElement("button");
    Object.assign(one, { type: "button", textContent: words, title: about, onclick: act });
    one.setAttribute("aria-label", `${about}: ${chart.title}`);
    bar.append(one);
  };
  button("PNG", "save this plot as a picture", async () => (await pictureOf(chart)).toBlob((blob) => saveAs(blob, chart, "png")));
  button("CSV", "save the values shown as a table", () => saveAs(new Blob([csvOf(chart)], { type: "text/csv" }), chart, "csv"));
  chart.element.append(bar);
};
