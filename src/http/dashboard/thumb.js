// Thumbnail of a local file: the browser decodes PNG, this module npy and uncompressed grey TIFF. Other
// formats have no thumbnail.

const SIDE = 72;
/** Largest file in bytes that is read for a thumbnail. */
const MAX_BYTES = 64 * 2 ** 20;

/** The first image of a file as a `Thumbnail`, or null. */
export async function thumb(file) {
  try {
    if (file.size > MAX_BYTES) return null;
    const bytes = await file.arrayBuffer();
    const first = new Uint8Array(bytes, 0, Math.min(8, bytes.byteLength));
    const image = first[0] === 0x89 && first[1] === 0x50 ? decoded(await createImageBitmap(file))
      : first[0] === 0x93 && first[1] === 0x4e ? npy(bytes)
        : (first[0] === 0x49 && first[1] === 0x49) || (first[0] === 0x4d && first[1] === 0x4d) ? tiff(bytes) : null;
    return image && new Thumbnail(image);
  } catch {
    // The service reports what is wrong with the file.
  }
  return null;
}

/** Width and height of a thumbnail of an image. */
function sizeOf({ width, height }) {
  const scale = SIDE / Math.max(width, height);
  return { width: Math.max(1, Math.round(width * scale)), height: Math.max(1, Math.round(height * scale)) };
}

/** An image that the browser has decoded, in the size of its thumbnail. */
function decoded(bitmap) {
  const { width, height } = sizeOf(bitmap);
  const context = new OffscreenCanvas(width, height).getContext("2d");
  context.drawImage(bitmap, 0, 0, width, height);
  bitmap.close();
  const { data } = context.getImageData(0, 0, width, height);
  return { width, height, at: (index) => data[4 * index + 1] };
}

/** A small canvas, and the smallest and largest value that it shows. */
class Thumbnail {
  /** `at(index)` is a value of the image. */
  constructor(image) {
    this.canvas = Object.assign(document.createElement("canvas"), sizeOf(image));
    const { width, height } = this.canvas;
    this.values = Float32Array.from({ length: width * height }, (_, index) => {
      const [y, x] = [Math.floor(index / width), index % width];
      return image.at(Math.floor((y * image.height) / height) * image.width + Math.floor((x * image.width) / width));
    });
    const finite = this.values.filter(Number.isFinite);
    [this.low, this.high] = [Math.min(...finite), Math.max(...finite)];
  }

  /** Draws the values between black at `low` and white at `high`; grey if these are equal. */
  draw(low, high) {
    const { width, height } = this.canvas;
    const image = new ImageData(width, height);
    this.values.forEach((value, index) => image.data.set([0, 0, 0].map(() => (high > low ? (255 * (value - low)) / (high - low) : 128)).concat(255), 4 * index));
    this.canvas.getContext("2d").putImageData(image, 0, 0);
  }
}

/** Draws thumbnails with one range of values, so that a dark capture is darker than a bright one. */
export function shade(thumbnails) {
  const low = Math.min(...thumbnails.map((one) => one.low));
  const high = Math.max(...thumbnails.map((one) => one.high));
  thumbnails.forEach((one) => one.draw(low, high));
}

function reader(bytes, offset, kind, little) {
  const view = new DataView(bytes);
  const size = { u1: 1, u2: 2, u4: 4, i2: 2, i4: 4, f4: 4, f8: 8, b1: 1 }[kind];
  const read = { u1: "getUint8", b1: "getUint8", u2: "getUint16", u4: "getUint32", i2: "getInt16", i4: "getInt32", f4: "getFloat32", f8: "getFloat64" }[kind];
  return size && ((index) => view[read](offset + size * index, little));
}

/** The first image of an npy array [..., rows, columns]. */
function npy(bytes) {
  const view = new DataView(bytes);
  const wide = view.getUint8(6) > 1;
  const length = wide ? view.getUint32(8, true) : view.getUint16(8, true);
  const start = wide ? 12 : 10;
  const header = new TextDecoder("latin1").decode(new Uint8Array(bytes, start, length));
  const [, order, kind] = /'descr': *'([<>|])(\w\d)'/.exec(header) ?? [];
  const shape = /'shape': *\(([^)]*)\)/.exec(header)?.[1].split(",").map(Number).filter((side) => side > 0) ?? [];
  if (header.includes("'fortran_order': True") || shape.length < 2) return null;
  const [height, width] = shape.slice(-2);
  const at = reader(bytes, start + length, kind, order !== ">");
  return at ? { width, height, at } : null;
}

/** The first page of an uncompressed grey TIFF; null for others. */
function tiff(bytes) {
  const view = new DataView(bytes);
  const little = view.getUint8(0) === 0x49;
  if (view.getUint16(2, little) !== 42) return null;
  const page = view.getUint32(4, little);
  const tags = new Map();
  for (let entry = 0; entry < view.getUint16(page, little); entry += 1) {
    const at = page + 2 + 12 * entry;
    const [size, count] = [view.getUint16(at + 2, little) === 3 ? 2 : 4, view.getUint32(at + 4, little)];
    const place = size * count > 4 ? view.getUint32(at + 8, little) : at + 8;
    const value = (index) => (size === 2 ? view.getUint16(place + 2 * index, little) : view.getUint32(place + 4 * index, little));
    tags.set(view.getUint16(at, little), { count, value });
  }
  const tag = (name, otherwise) => tags.get(name)?.value(0) ?? otherwise;
  const [width, height, bits] = [tag(256), tag(257), tag(258, 1)];
  const kind = { 1: { 8: "u1", 16: "u2", 32: "u4" }, 3: { 32: "f4", 64: "f8" } }[tag(339, 1)]?.[bits];
  if (tag(259, 1) !== 1 || tag(277, 1) !== 1 || !kind || !tags.has(273)) return null;
  const rows = tag(278, height);
  const strips = Array.from({ length: tags.get(273).count }, (_, index) => reader(bytes, tags.get(273).value(index), kind, little));
  const at = (index) => strips[Math.floor(index / (rows * width))](index % (rows * width));
  return { width, height, at };
}
