"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);

  const unpack = (text, Type) => {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return new Type(bytes.buffer);
  };
  const time = unpack(data.time, Float64Array);
  const series = Object.fromEntries(Object.entries(data.series).map(([name, text]) => [name, unpack(text, Float32Array)]));
  const step = data.decimated ? 2 : 1;

  // Krzywinski's palette of twelve that colour-blind eyes tell apart; those hard to see on white come last.
  const COLOURS = ["#008df9", "#ff6e3a", "#009f81", "#9a4dff", "#e20134", "#e0a100",
    "#00b4e6", "#ff5aaf", "#b5307c", "#a85a3c", "#00d0ab", "#d98ad7"];
  const colour = (i) => COLOURS[i % COLOURS.length];
  const STATES = {
    OK: ["#8fbf9f", ""],
    SUSPECT: ["#e6c84f", "/"],
    AMBIGUOUS: ["#e08a3c", "x"],
    FAULTY: ["#c0392b", "x"],
    STALE: ["#5b6b8c", "."],
    UNCHECKED: ["#b8bec6", ""],
    EXCLUDED: ["#7a5c99", "-"],
  };
  const SHOWN = 1500; // spans drawn at once: more than a screen has columns

  const before = (t) => { // number of spans that begin before t
    let low = 0, high = time.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (time[middle] < t) low = middle + 1; else high = middle;
    }
    return low;
  };

  // Points of one series within a range: smallest and largest of every group of spans, so that no spike is lost.
  const draw = (name, range) => {
    const values = series[name];
    const first = Math.max(0, before(range[0]) - 1), last = Math.min(time.length, before(range[1]) + 1);
    const group = Math.max(1, Math.ceil((last - first) / SHOWN));
    const x = [], y = [];
    if (group === 1 && step === 1) {
      for (let i = first; i < last; i++) { x.push(time[i]); y.push(values[i]); }
      return [x, y];
    }
    for (let i = first; i < last; i += group) {
      const end = Math.min(last, i + group);
      let low = Infinity, high = -Infinity, lowAt = i, highAt = i;
      for (let k = i; k < end; k++) {
        const least = values[step * k], most = values[step * k + step - 1];
        if (least < low) { low = least; lowAt = k; }
        if (most > high) { high = most; highAt = k; }
      }
      if (low > high) { x.push(time[i]); y.push(NaN); continue; }
      if (lowAt === highAt) {
        // Both lie somewhere within one span: which came first is not known, the nearer one makes no false step.
        const half = (time[Math.min(lowAt + 1, time.length - 1)] - time[lowAt]) / 2;
        const ends = Math.abs(y[y.length - 1] - high) < Math.abs(y[y.length - 1] - low) ? [high, low] : [low, high];
        x.push(time[lowAt], time[lowAt] + half);
        y.push(...ends);
      } else if (lowAt < highAt) { x.push(time[lowAt], time[highAt]); y.push(low, high); }
      else { x.push(time[highAt], time[lowAt]); y.push(high, low); }
    }
    return [x, y];
  };

  const whole = [data.start, Math.max(data.end, data.start + 1e-9)];
  let shown = whole;
  const dark = () => document.documentElement.classList.contains("dark");
  const ink = () => getComputedStyle(document.documentElement).getPropertyValue("--text").trim();
  const grid = () => getComputedStyle(document.documentElement).getPropertyValue("--line").trim();

  const line = (name, label, more) => {
    const [x, y] = draw(name, shown);
    return { type: "scatter", mode: "lines", name: label, x, y, meta: name, line: { width: 1.2 }, connectgaps: false, ...more };
  };
  const channelLine = (name, i, more) => line(name, data.names[i], {
    line: { width: 1.1, color: colour(i) }, legendrank: 1001 + i, legendgroup: `channel ${i}`, ...more,
  });

  const faultShapes = () => data.faults.map((fault) => ({
    type: "rect", xref: "x", yref: "paper", x0: Math.max(fault.start_s, whole[0]), x1: fault.stop_s ?? whole[1],
    y0: 0, y1: 1, layer: "below", line: { width: 0 }, fillcolor: dark() ? "rgba(255,140,60,0.16)" : "rgba(230,110,30,0.13)",
  }));

  const layout = (height, more) => {
    const plain = { gridcolor: grid(), zerolinecolor: grid(), linecolor: grid(), automargin: true };
    const axes = { xaxis: { title: { text: "s from the first sample" } }, yaxis: {}, ...more };
    for (const name of Object.keys(axes)) {
      if (/^[xy]axis/.test(name)) axes[name] = { ...plain, ...axes[name] };
    }
    axes.xaxis.range = [...shown];
    // The time axis belongs under the lowest of the plots above each other.
    axes.xaxis.anchor = Object.keys(axes).filter((name) => name.startsWith("yaxis")).pop().replace("axis", "");
    return {
      height, margin: { l: 70, r: 10, t: 10, b: 45 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: ink(), size: 12 }, hovermode: "closest", dragmode: "zoom", shapes: faultShapes(),
      modebar: { bgcolor: "rgba(0,0,0,0)", color: grid(), activecolor: ink() },
      legend: { orientation: "h", y: 1.02, yanchor: "bottom" }, ...axes,
    };
  };

  const timeline = () => {
    const open = data.names.map((_, i) => ({ state: data.firstStates[i] ?? "UNCHECKED", from: whole[0], reason: "" }));
    const bars = {};
    const close = (i, at) => {
      const { state, from, reason } = open[i];
      (bars[state] ??= []).push({ y: data.names[i], base: from, x: Math.max(at - from, 0), text: `${state} ${reason}` });
    };
    for (const event of data.events) {
      const i = data.names.indexOf(event.channel);
      close(i, event.at_s);
      open[i] = { state: event.state, from: event.at_s, reason: event.reason };
    }
    data.names.forEach((_, i) => close(i, whole[1]));
    const traces = Object.keys(STATES).filter((state) => bars[state]).map((state) => ({
      type: "bar", orientation: "h", name: state, y: bars[state].map((b) => b.y), x: bars[state].map((b) => b.x),
      base: bars[state].map((b) => b.base), text: bars[state].map((b) => b.text), textposition: "none",
      hovertemplate: "%{y} %{text}<br>from %{base:.3f} s<extra></extra>",
      marker: { color: STATES[state][0], line: { width: 0 }, pattern: { shape: STATES[state][1], size: 7, solidity: 0.25, fillmode: "overlay", fgcolor: "#ffffff", fgopacity: 0.7 } },
    }));
    return [traces, layout(110 + 24 * data.names.length, {
      barmode: "overlay", bargap: 0.25, yaxis: { autorange: "reversed", fixedrange: true, type: "category", categoryarray: data.names },
    })];
  };

  const statistic = () => {
    const largest = (name) => series[name].reduce((most, value) => (value > most ? value : most), 0);
    const log = largest("statistic") > 10 * largest("threshold");
    return [[
      line("statistic", "statistic", { line: { width: 1.2, color: ink() } }),
      line("threshold", "threshold", { line: { width: 1.8, color: "#e0662f", dash: "dash" } }),
    ], layout(280, { yaxis: { type: log ? "log" : "linear", title: { text: log ? "log scale" : "" }, exponentformat: "power" } })];
  };

  const rate = () => {
    const traces = [], more = {};
    [..."xyz"].forEach((axis, k) => {
      const at = { xaxis: "x", yaxis: k ? `y${k + 1}` : "y" };
      const hidden = { hoverinfo: "skip", showlegend: false, line: { width: 0, color: "rgba(128,128,128,0)" } };
      traces.push(line(`lower.${axis}`, "", { ...hidden, ...at }));
      traces.push(line(`upper.${axis}`, "", { ...hidden, fill: "tonexty", fillcolor: "rgba(128,128,128,0.3)", ...at }));
      data.names.forEach((_, i) => {
        const name = `reading.${axis}.${i}`;
        if (series[name]) traces.push(channelLine(name, i, { showlegend: !traces.some((t) => t.legendgroup === `channel ${i}`), ...at }));
      });
      traces.push(line(`rate.${axis}`, "fused", { line: { width: 1.3, color: ink() }, legendgroup: "fused", showlegend: k === 0, ...at }));
      more[k ? `yaxis${k + 1}` : "yaxis"] = { title: { text: `${axis}, rad/s` }, domain: [1 - (k + 1) / 3 + 0.02, 1 - k / 3 - 0.01] };
    });
    return [traces, layout(720, more)];
  };

  const residual = () => {
    const count = data.names.length, more = {}, traces = [];
    data.names.forEach((name, i) => {
      const axis = i ? `${i + 1}` : "";
      traces.push(channelLine(`residual.${i}`, i, { yaxis: `y${axis}` }));
      more[`yaxis${axis}`] = { title: { text: name }, domain: [1 - (i + 1) / count + 0.01, 1 - i / count - 0.01], nticks: 4 };
    });
    return [traces, layout(80 + 95 * count, { ...more, showlegend: false })];
  };

  const PLOTS = { timeline, statistic, rate, residual };
  const config = { responsive: true, displaylogo: false, doubleClick: false, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"] };
  let busy = false;

  const render = () => Promise.all(Object.entries(PLOTS).map(([name, build]) => {
    const [traces, shape] = build();
    return Plotly.react(name, traces, shape, config);
  }));

  // A zoom in one plot is a zoom in all, and brings in the detail that the range has.
  const zoom = async (range) => {
    if (busy) return;
    busy = true;
    shown = range;
    await Promise.all(Object.keys(PLOTS).map((name) => {
      const div = document.getElementById(name);
      const change = { "xaxis.range": [...range], "xaxis.autorange": false };
      const redrawn = div.data.map((trace) => trace.meta && draw(trace.meta, range));
      if (!redrawn[0]) return Plotly.relayout(div, change);
      return Plotly.update(div, { x: redrawn.map((r) => r[0]), y: redrawn.map((r) => r[1]) }, change);
    }));
    busy = false;
  };

  const follow = (change) => {
    if (busy) return;
    const range = change["xaxis.range"] ?? [change["xaxis.range[0]"], change["xaxis.range[1]"]];
    if (change["xaxis.autorange"]) zoom(whole);
    else if (range[0] !== undefined) zoom([+range[0], +range[1]]);
  };

  if (data.decimated) {
    const note = document.getElementById("spans");
    note.hidden = false;
    note.textContent = `A long recording: of every ${data.width} samples the smallest and the largest value are drawn; `
      + "close up, the lines between them are no course of time.";
  }

  const media = window.matchMedia("(prefers-color-scheme: dark)");
  const paint = (isDark) => {
    document.documentElement.classList.toggle("dark", isDark);
    return render();
  };
  paint(media.matches).then(() => {
    for (const name of Object.keys(PLOTS)) {
      const div = document.getElementById(name);
      div.on("plotly_relayout", follow);
      div.on("plotly_doubleclick", () => zoom(whole));
    }
    document.documentElement.dataset.ready = "yes";
  });
  media.addEventListener("change", (event) => paint(event.matches));
  document.getElementById("theme").addEventListener("click", () => paint(!dark()));
})();
