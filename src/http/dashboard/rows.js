// A table that holds only the visible rows, so that lists of thousands scroll smoothly.

import { h } from "./dom.js";

/** Rows that are kept above and below the visible ones. */
const SPARE = 10;

/**
 * Creates a table with `columns` (`{title, class, fill(cell, item, before)}`) in a scroller. `show(items,
 * complete)` shows items that have an `id`, and does not touch the rows of unchanged items.
 */
export function table(caption, columns, scroller, rowHeight) {
  const head = h("tr", { role: "row" }, columns.map((column) => h("th", { scope: "col", role: "columnheader", class: column.class }, column.title)));
  const above = h("tr", { class: "space", "aria-hidden": "true" });
  const below = h("tr", { class: "space", "aria-hidden": "true" });
  const body = h("tbody", { role: "rowgroup" }, above, below);
  const element = h("table", { class: "list", role: "table", "aria-label": caption }, h("thead", { role: "rowgroup" }, head), body);
  const shown = new Map();
  let items = [];

  function range() {
    const top = body.getBoundingClientRect().top - scroller.getBoundingClientRect().top;
    const height = rowHeight();
    const first = Math.max(0, Math.floor(-top / height) - SPARE);
    const last = Math.min(items.length, Math.ceil((scroller.clientHeight - top) / height) + SPARE);
    return [first, Math.max(first, last), height];
  }

  function draw() {
    const [first, last, height] = range();
    const wanted = new Set(items.slice(first, last).map((item) => item.id));
    for (const [id, row] of shown) {
      if (wanted.has(id)) continue;
      row.element.remove();
      shown.delete(id);
    }
    let after = above;
    for (let index = first; index < last; index += 1) {
      const item = items[index];
      let row = shown.get(item.id);
      if (!row) {
        row = make(item);
        shown.set(item.id, row);
      }
      if (row.item !== item) fillRow(row, item);
      if (row.element.previousSibling !== after) after.after(row.element);
      row.element.setAttribute("aria-rowindex", index + 2);
      after = row.element;
    }
    space(above, first * height);
    space(below, (items.length - last) * height);
    return [first, last];
  }

  function space(row, height) {
    const text = `${height}px`;
    if (row.style.height !== text) row.style.height = text;
    row.hidden = height === 0;
  }

  function make() {
    const cells = columns.map((column) => h("td", { role: "cell", class: column.class }));
    return { element: h("tr", { role: "row" }, cells), cells, item: null };
  }

  function fillRow(row, item) {
    columns.forEach((column, index) => column.fill(row.cells[index], item, row.item));
    row.item = item;
  }

  return {
    element,
    draw,
    range,
    show(next, complete) {
      items = next;
      element.setAttribute("aria-rowcount", complete ? items.length + 1 : -1);
      return draw();
    },
    forget() {
      shown.forEach((row) => row.element.remove());
      shown.clear();
    },
  };
}
