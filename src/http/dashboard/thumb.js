// Thumbnail of a local file: the browser decodes PNG, this module npy and uncompressed grey TIFF. Other
// formats have no thumbnail.

const SIDE = 72;
/** Largest file in bytes that is read for a thumbnail. */
const MAX_BYTES = 64 * 2 ** 20;

/** A canvas with the first image of a file, or null. */
export async function thumb(file) {
  try {
    if (file.size > MAX_BYTES) return null;
    const bytes = await file.arrayBuffer();
    const first = new Uint8Array(bytes, 0, Math.min(8, bytes.byteLength));
    if (first[0] === 0x89 && first[1] === 0x50) return drawn(await createImageBitmap(file));
    if (first[0] === 0x93 && first[1] === 0x4e) return grey(npy(bytes));
    if ((first[0] === 0x49 && first[1] === 0x49) || (first[0] === 0x4d && first[1] === 0x4d)) return grey(tiff(bytes));
  } catch {
    // The service reports what is wrong with the file.
  }
  return null;
}

function canvasOf(width, height) {
  const scale = SIDE / Math.max(width, height);
  return Object.assign(document.createElement("canvas"), { width: Math.max(1, Math.round(width * scale)), height: Math.max(1, Math.round(height * scale)), className: "thumbnail" });
}

function drawn(bitmap) {
  const canvas = canvasOf(bitmap.width, bitmap.height);
  canvas.getContext("2d").drawImage(bitmap, 0, 0, canvas.width, canvas.height);
  bitmap.close();
  return canvas;
}

/** Draws `{width, height, at(index)}` between its smallest and largest value; grey if they are equal. */
function grey(picture) {
  if (!picture) return null;
  const canvas = canvasOf(picture.width, picture.height);
  const { width, height } = canvas;
  const values = new Float32Array(width * height);
  for (let y = 0; y < height; y += 1) {
    for (let x = 0; x < width; x += 1) {
      const [row, column] = [Math.floor((y * picture.height) / height), Math.floor((x * picture.width) / width)];
      values[y * width + x] = picture.at(row * picture.width + column);
    }
  }
  const low = values.reduce((one, other) => Math.min(one, other), Infinity);
  const span = values.reduce((one, other) => Math.max(one, other), -Infinity) - low;
  const image = new ImageData(width, height);
  values.forEach((value, index) => image.data.set([0, 0, 0].map(() => (span > 0 ? (255 * (value - low)) / span : 128)).concat(255), 4 * index));
  canvas.getContext("2d").putImageData(image, 0, 0);
  return canvas;
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
