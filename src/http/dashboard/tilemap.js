// The tiles of a snapshot with their states, and the convergence plot of a selected tile.

import { convergence } from "./convergence.js";
import { figure, iterationsOf } from "./format.js";
import { get } from "./api.js";
import { h, put, s } from "./dom.js";

const COLOURS = { r: "red", g: "green", b: "blue" };

/** The place on one axis of the tiles that begin at each number: each takes its half of an overlap. `spans` has begin and end of all tiles. */
function shares(spans) {
  const sorted = [...new Map(spans)].sort(([one], [other]) => one - other);
  return new Map(sorted.map(([start, end], index) => {
    const from = index === 0 ? start : (start + sorted[index - 1][1]) / 2;
    const to = index === sorted.length - 1 ? end : (end + sorted[index + 1][0]) / 2;
    return [start, { from, length: to - from }];
  }));
}

export class TileMap {
  constructor(job, signal) {
    Object.assign(this, { job, signal, chosen: null, tiles: [] });
    this.map = h("div");
    this.select = h("select", { id: "tile" });
    this.select.addEventListener("change", () => this.choose(this.select.value === "" ? null : Number(this.select.value)));
    this.label = h("label", { for: "tile", class: "row muted" }, "of tile", this.select);
    this.note = h("p", { class: "muted" });
    this.plot = h("div");
    this.tilesCard = h("section", { class: "card", "aria-label": "Tiles" }, h("h2", null, "Tiles"), this.map, this.note);
    // The plot has the width of its card.
    addEventListener("resize", () => this.points && convergence(this.plot, this.points), { signal });
    this.plotCard = h("section", { class: "card", "aria-label": "Convergence" },
      h("h2", { class: "row" }, "Convergence", h("span", { class: "grow" }), this.label), this.plot);
  }

  async renew(snapshot) {
    this.snapshot = snapshot;
    const found = await get(`/view/jobs/${this.job.id}/snapshots/${snapshot}/tiles`, this.signal);
    if (found.items !== this.found) {
      this.found = found.items;
      // Show the run that begins last among those that contain the snapshot; the history is from that run.
      const first = Math.max(...found.items.map((tile) => tile.snapshots.first));
      this.tiles = found.items.filter((tile) => tile.snapshots.first === first);
      this.draw();
      this.options();
    }
    await this.history();
  }

  choose(tile) {
    this.chosen = tile;
    this.draw();
    this.history();
  }

  /** The selected tile, or else a running one, or else the one that ended last. */
  current() {
    if (this.chosen !== null) return this.chosen;
    const runs = this.tiles.find((tile) => tile.state === "running" && tile.iterations > 0);
    return (runs ?? this.tiles.filter((tile) => tile.state === "done").at(-1) ?? this.tiles[0])?.tile ?? 0;
  }

  async history() {
    const { points } = await get(`/view/jobs/${this.job.id}/snapshots/${this.snapshot}/tiles/${this.current()}/history`, this.signal);
    if (points === this.points) return;
    this.points = points;
    convergence(this.plot, points);
  }

  options() {
    const state = (tile) => `${tile.tile + 1} (${tile.state})`;
    put(this.select, h("option", { value: "" }, "running, or ended last"), this.tiles.map((tile) => h("option", { value: tile.tile, selected: tile.tile === this.chosen }, state(tile))));
  }

  draw() {
    const { job } = this;
    const { height, width } = job.shape;
    const done = this.tiles.filter((tile) => tile.state === "done");
    const worst = Math.max(...done.map((tile) => tile.residual ?? 0));
    const run = this.tiles[0]?.snapshots;
    const together = run?.count > 1 ? ` of snapshots ${run.first} to ${run.first + run.count - 1}, reconstructed jointly,` : "";
    const text = `${done.length} of ${this.tiles.length} tiles${together} are done`;
    const unit = Math.max(width, height) / 100;
    // With a mosaic, the tiles of the four sub-images cover the same pixels: each gets a quarter of the area.
    const parts = job.shape.mosaic ? 2 : 1;
    const columns = shares(this.tiles.map((tile) => [tile.column, tile.column + tile.width]));
    const rows = shares(this.tiles.map((tile) => [tile.row, tile.row + tile.height]));
    const at = ({ from, length }, part) => from + unit / 2 + (part * (length - unit)) / parts;
    const rectangle = (tile) => {
      const [across, down] = [columns.get(tile.column), rows.get(tile.row)];
      return s("rect", {
        x: at(across, tile.plane % 2), y: at(down, Math.floor(tile.plane / 2)),
        width: (across.length - unit) / parts, height: (down.length - unit) / parts, rx: unit,
        class: `tile ${tile.state}${tile.tile === this.chosen ? " chosen" : ""}`, "stroke-width": unit / 2,
        onclick: () => {
          this.select.value = tile.tile;
          this.choose(tile.tile);
        },
      }, s("title", null, `tile ${tile.tile + 1}${job.shape.mosaic ? ` (${COLOURS[job.shape.mosaic[tile.plane]]})` : ""}: ${tile.state}, ${Math.round(100 * tile.fraction)} %, ${tile.iterations} iterations${tile.residual === null ? "" : `, residual ${figure(tile.residual)}`}`));
    };
    // A single tile is the whole picture: neither a map nor a choice is needed.
    this.tilesCard.hidden = this.label.hidden = this.tiles.length === 1;
    put(this.map, s("svg", { viewBox: `0 0 ${width} ${height}`, class: "tiles", role: "img", "aria-label": text }, this.tiles.map(rectangle)));
    const most = iterationsOf(this.job.schedule);
    const runs = this.tiles.filter((tile) => tile.state === "running" && tile.iterations > 0);
    const going = runs.map((tile) => ` Tile ${tile.tile + 1}: iteration ${tile.iterations} of at most ${most}.`).join("");
    put(this.note, `${text}${done.length ? `; the largest residual is ${figure(worst)}` : ""}.${most > 0 ? going : ""}`);
  }
}
