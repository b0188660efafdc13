// Copyright 2026 fdi_ros maintainers
// SPDX-License-Identifier: Apache-2.0

// Tables that a reader sorts by a click on a head and filters by words, and wide ones on a narrow screen.

// A cell that is a figure as a whole: with a unit (62.5 Hz), an interval (93.2% to 98.1%), a remark (0 (at most 2.83%)).
const NUMBER = "[-+]?\\d+(?:\\.\\d+)?(?:e[-+]?\\d+)?";
const UNIT = "(?:\\s?%| [^\\d\\s()]+)?";
const FIGURE = new RegExp(`^(${NUMBER})${UNIT}(?: to ${NUMBER}${UNIT})?(?: \\(.*\\))?$`, "i");

const figure = (text) => {
  const found = FIGURE.exec(text);
  return found ? Number(found[1]) : null;
};

// Numbers within words by their size: as many decimals for all, since 0.05 is not more than 0.1.
const DECIMAL = /(^|[\s=+-])(\d+\.)(\d+)(?=$|[\s%,;)])/g;
const wordKey = (text) => text.replace(DECIMAL, (_, before, whole, decimals) => before + whole + decimals.padEnd(9, "0"));

// Order of the cells of a column; what has no figure among figures stays at the end, whatever the sign.
function cellOrder(texts, sign) {
  const none = (text) => text === "-" || text === "";
  if (!texts.every((text) => none(text) || figure(text) !== null)) {
    return (a, b) => sign * wordKey(a).localeCompare(wordKey(b), undefined, { numeric: true });
  }
  return (a, b) => (none(a) || none(b) ? none(a) - none(b) : sign * (figure(a) - figure(b)));
}

function sortable(table) {
  const body = table.tBodies[0];
  const rows = [...body.rows];
  const order = { column: -1, sign: 1 };
  table.querySelectorAll("thead th").forEach((head, column) => {
    const button = document.createElement("button");
    button.textContent = head.textContent;
    head.replaceChildren(button);
    button.addEventListener("click", () => {
      order.sign = order.column === column ? -order.sign : 1;
      order.column = column;
      for (const other of head.parentNode.children) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", order.sign > 0 ? "ascending" : "descending");
      const keys = new Map(rows.map((row) => [row, row.cells[column].textContent.trim()]));
      const compare = cellOrder([...keys.values()], order.sign);
      body.append(...rows.sort((a, b) => compare(keys.get(a), keys.get(b))));
    });
  });
  const filter = document.createElement("input");
  Object.assign(filter, { type: "search", placeholder: "filter", className: "filter" });
  filter.setAttribute("aria-label", "filter the rows");
  filter.addEventListener("input", () => {
    const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    for (const row of rows) {
      const text = row.textContent.toLowerCase();
      row.hidden = !words.every((word) => text.includes(word));
    }
  });
  table.closest(".scroll").before(filter);
}

// A table that is wider than its place has narrow columns; if it still is, it is a list of its rows, each cell after
// its head.
const narrow = matchMedia("(max-width: 640px)");

function stack(table) {
  const wide = () => table.offsetWidth > table.parentNode.clientWidth;
  table.classList.remove("stacked", "tight");
  if (!wide()) return;
  table.classList.add("tight");
  if (!wide()) return;
  const heads = [...table.tHead.rows[0].cells].map((head) => head.textContent);
  for (const row of table.tBodies[0].rows) {
    for (const cell of row.cells) cell.dataset.head = heads[cell.cellIndex];
  }
  table.classList.add("stacked");
}

const stackAll = () => document.querySelectorAll(".scroll:not(.fold) table").forEach(stack);

document.querySelectorAll("table.sort").forEach(sortable);
stackAll();
narrow.addEventListener("change", stackAll);
