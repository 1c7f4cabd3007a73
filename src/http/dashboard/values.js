// Exact values of pictures, which the service sends as float32 tile by tile.

import { ask, refused } from "./api.js";

/** Largest number of tiles in the cache: 16 MiB. */
const MAX_TILES = 64;
/** Side of a tile in pixels. */
const TILE = 256;
const held = new Map();

/** Values of a tile. `version` changes when the picture has changed on the service. */
export function tileValues(base, level, row, column, version = 0) {
  const key = `${version} ${base}/values/${level}/${row}/${column}`;
  if (!held.has(key)) {
    const read = load(key.slice(key.indexOf(" ") + 1));
    held.set(key, read);
    read.catch(() => held.delete(key));
    if (held.size > MAX_TILES) held.delete(held.keys().next().value);
  }
  return held.get(key);
}

async function load(path) {
  const response = await ask(path);
  if (!response.ok) throw await refused(response);
  return new Float32Array(await response.arrayBuffer());
}

/** Values of up to four tiles of a picture at full resolution, spread over it, for its histogram. */
export async function sampled({ base, height, width, version }) {
  const places = (side) => {
    const count = Math.ceil(side / TILE);
    return Array.from({ length: Math.min(2, count) }, (_, index) => Math.floor(((index + 0.5) * count) / Math.min(2, count)));
  };
  const at = places(height).flatMap((row) => places(width).map((column) => [row, column]));
  return Promise.all(at.map(([row, column]) => tileValues(base, 0, row, column, version)));
}

/** Value of a pixel: one number, or three of a colour picture. `picture` has `base`, `height`, `width` and `version`. */
export async function pixel(picture, row, column) {
  const [tileRow, tileColumn] = [Math.floor(row / TILE), Math.floor(column / TILE)];
  const data = await tileValues(picture.base, 0, tileRow, tileColumn, picture.version);
  const rows = Math.min(TILE, picture.height - TILE * tileRow);
  const columns = Math.min(TILE, picture.width - TILE * tileColumn);
  const channels = data.length / (rows * columns);
  const at = channels * ((row - TILE * tileRow) * columns + column - TILE * tileColumn);
  return [...data.subarray(at, at + channels)];
}

/** Mean of the colours of a value. */
export const grey = (value) => value.reduce((sum, one) => sum + one, 0) / value.length;

/** Values of a pixel in all `frames` frames, read from the picture of its row through time. */
export async function throughTime({ base, width, version }, frames, row, column) {
  const slice = { base: `${base}/slice-${row}`, height: frames, width, version };
  return Promise.all(Array.from({ length: frames }, async (_, frame) => grey(await pixel(slice, frame, column))));
}

/** Means of a region [top, left, bottom, right], both ends included, in all frames. */
export async function regionMeans({ base, height, width, version }, frames, [top, left, bottom, right]) {
  const mean = async (frame) => {
    let [sum, count] = [0, 0];
    for (let row = Math.floor(top / TILE); TILE * row <= bottom; row += 1) {
      for (let column = Math.floor(left / TILE); TILE * column <= right; column += 1) {
        const data = await tileValues(`${base}/frame-${frame + 1}`, 0, row, column, version);
        const [rows, columns] = [Math.min(TILE, height - TILE * row), Math.min(TILE, width - TILE * column)];
        const channels = data.length / (rows * columns);
        const [first, last] = [Math.max(0, left - TILE * column), Math.min(columns - 1, right - TILE * column)];
        for (let at = Math.max(0, top - TILE * row); at <= Math.min(rows - 1, bottom - TILE * row); at += 1) {
          const line = data.subarray(channels * (at * columns + first), channels * (at * columns + last + 1));
          sum += line.reduce((all, one) => all + one, 0);
          count += line.length;
        }
      }
    }
    return sum / count;
  };
  return Promise.all(Array.from({ length: frames }, (_, frame) => mean(frame)));
}

/** Values along a line between two pixels [row, column], at steps of one pixel. */
export async function alongLine(picture, [row0, column0], [row1, column1]) {
  const steps = Math.max(1, Math.round(Math.hypot(row1 - row0, column1 - column0)));
  const at = (from, to, step) => Math.round(from + ((to - from) * step) / steps);
  return Promise.all(Array.from({ length: steps + 1 }, async (_, step) => grey(await pixel(picture, at(row0, row1, step), at(column0, column1, step)))));
}
