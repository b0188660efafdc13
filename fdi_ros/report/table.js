// Copyright 2026 fdi_ros maintainers
// SPDX-License-Identifier: Apache-2.0

// Tables that a reader sorts by a click on a head and filters by words.

const figure = (text) => {
  const found = /^[-+]?\d[\d.]*(e[-+]?\d+)?/i.exec(text.trim());
  return found ? Number(found[0]) : null;
};

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
      const keys = new Map(rows.map((row) => [row, row.cells[column].textContent]));
      const numbers = rows.every((row) => keys.get(row) === "-" || figure(keys.get(row)) !== null);
      const compare = (a, b) => {
        const [x, y] = [keys.get(a), keys.get(b)];
        if (!numbers) return x.localeCompare(y);
        // What has no figure stays at the end.
        if (x === "-" || y === "-") return order.sign * ((x === "-") - (y === "-"));
        return figure(x) - figure(y);
      };
      body.append(...rows.sort((a, b) => order.sign * compare(a, b)));
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

document.querySelectorAll("table.sort").forEach(sortable);
