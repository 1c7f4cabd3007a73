// A generated scene: a square that moves over a pattern, coded by random masks, as npy files.

const [BLACK, LIGHT] = [100, 2000];

/** Colours of a cell of 2x2 pixels, and their sensitivity to the square and to the background. */
const CELL = [0, 1, 1, 2];
const TINTS = [[1, 0.4], [0.35, 0.7], [0.15, 1]];

/** Simulates `frames` frames of `height` x `width` and a snapshot, for a grey sensor or one with the mosaic rggb;
 * returns the files' bytes. */
export function scene(frames, height, width, seed = 1, mosaic = false) {
  const masks = new Float32Array(frames * height * width);
  const truth = new Float32Array(masks.length);
  const measurement = new Float32Array(height * width);
  const random = generator(seed);
  const side = Math.round(Math.min(height, width) / 4);
  for (let frame = 0; frame < frames; frame += 1) {
    const left = Math.round((width - side) * (frame + 0.5) / frames);
    const top = Math.round(height / 3);
    for (let row = 0; row < height; row += 1) {
      for (let column = 0; column < width; column += 1) {
        const at = (frame * height + row) * width + column;
        const inside = row >= top && row < top + side && column >= left && column < left + side;
        const wave = 0.35 + 0.2 * Math.sin(column / 9) * Math.cos(row / 13);
        const tint = mosaic ? TINTS[CELL[(row % 2) * 2 + (column % 2)]][inside ? 0 : 1] : 1;
        truth[at] = tint * (inside ? 0.95 : wave);
        masks[at] = random() < 0.5 ? 0 : 1;
        measurement[row * width + column] += masks[at] * truth[at];
      }
    }
  }
  const pixels = height * width;
  const capture = (frame) => npy([height, width], Float32Array.from({ length: pixels }, (_, at) => BLACK + (frame === null ? 1 : 0.5 * masks[frame * pixels + at]) * LIGHT));
  return {
    masks: npy([frames, height, width], masks),
    /** The masks with 255 for fully open, like those of an 8-bit camera. */
    loud: () => npy([frames, height, width], masks.map((value) => 255 * value)),
    /** Captures of a white board: each pattern with the mask, then white and black. */
    captures: () => ({
      patterns: Array.from({ length: frames }, (_, frame) => capture(frame)),
      white: capture(null),
      black: npy([height, width], new Float32Array(pixels).fill(BLACK)),
    }),
    measurement: npy([1, height, width], measurement),
    /** A file with the snapshot `count` times. */
    repeated: (count) => npy([count, height, width], Float32Array.from({ length: count * pixels }, (_, at) => measurement[at % pixels])),
    /** The snapshot in the middle of a larger picture, with a border of this many pixels. */
    framed: (border) => {
      const wide = width + 2 * border;
      const picture = new Float32Array((height + 2 * border) * wide).fill(0.5);
      for (let row = 0; row < height; row += 1) picture.set(measurement.subarray(row * width, (row + 1) * width), (row + border) * wide + border);
      return npy([1, height + 2 * border, wide], picture);
    },
    /** The snapshot behind masks that have moved down and to the right by whole pixels. */
    moved: (down, right) => {
      const inside = (place, side) => Math.min(side - 1, Math.max(0, place));
      const moved = new Float32Array(pixels);
      for (let at = 0; at < masks.length; at += 1) {
        const [frame, row, column] = [Math.floor(at / pixels), Math.floor(at / width) % height, at % width];
        moved[at % pixels] += truth[at] * masks[frame * pixels + inside(row - down, height) * width + inside(column - right, width)];
      }
      return npy([1, height, width], moved);
    },
    /** The snapshot in counts of a camera with this full scale, from which no dark was subtracted. */
    undarkened: (scale) => npy([1, height, width], measurement.map((value) => scale * (value + 0.1 * frames))),
    /** A map of bad pixels: a column that is dead. */
    dead: () => npy([height, width], Float32Array.from({ length: pixels }, (_, at) => (at % width === 7 ? 1 : 0))),
    /** A MATLAB file (level 5) with masks and snapshot under names of somebody's own. */
    matlab: () => mat([["patterns", [height, width, frames], masks], ["shots", [height, width], measurement]]),
    truth: npy([frames, height, width], truth),
  };
}

/** Simulates a spectral camera: one mask, and bands that are displaced to the right by `step` pixels each. A square in the left
 * half is bright in the first bands, one in the right half in the last. */
export function spectral(bands, height, width, step) {
  const { masks, truth } = planes(bands, height, width);
  const wide = width + step * (bands - 1);
  const measurement = new Float32Array(height * wide);
  for (let at = 0; at < truth.length; at += 1) {
    const [band, row, column] = [Math.floor(at / (height * width)), Math.floor(at / width) % height, at % width];
    measurement[row * wide + column + step * band] += masks[row * width + column] * truth[at];
  }
  return { mask: npy([height, width], masks.slice(0, height * width)), measurement: npy([1, height, wide], measurement), truth: npy([bands, height, width], truth) };
}

function planes(bands, height, width) {
  const truth = new Float32Array(bands * height * width).fill(0.1);
  const [top, bottom] = [Math.round(height / 4), Math.round((3 * height) / 4)];
  for (let band = 0; band < bands; band += 1) {
    const early = band < bands / 2 ? 0.9 : 0.2;
    for (let row = top; row < bottom; row += 1) {
      for (let column = Math.round(width / 8); column < Math.round((7 * width) / 8); column += 1) {
        if (Math.abs(column - width / 2) < width / 16) continue;
        truth[(band * height + row) * width + column] = column < width / 2 ? early : 1.1 - early;
      }
    }
  }
  const random = generator(5);
  return { truth, masks: Float32Array.from({ length: height * width }, () => (random() < 0.5 ? 0 : 1)) };
}

/** Random numbers by xorshift, which are the same on every machine. */
function generator(seed) {
  let state = seed >>> 0;
  return () => {
    state ^= state << 13;
    state ^= state >>> 17;
    state ^= state << 5;
    return (state >>> 0) / 2 ** 32;
  };
}

/** A MATLAB file of single-precision arrays [name, [rows, columns, frames], values], uncompressed; the values are [frame, row, column]. */
function mat(arrays) {
  const element = (type, bytes) => {
    const tag = Buffer.alloc(8);
    tag.writeUInt32LE(type, 0);
    tag.writeUInt32LE(bytes.length, 4);
    return Buffer.concat([tag, bytes, Buffer.alloc(-bytes.length & 7)]);
  };
  const [INT8, INT32, UINT32, SINGLE, MATRIX] = [1, 5, 6, 7, 14];
  const words = (numbers) => Buffer.from(Int32Array.from(numbers).buffer);
  const head = Buffer.alloc(128, " ");
  head.write("MATLAB 5.0 MAT-file");
  head.fill(0, 116, 124);
  head.writeUInt16LE(0x0100, 124);
  head.write("IM", 126);
  return Buffer.concat([head, ...arrays.map(([name, shape, values]) => {
    const [rows, columns, frames = 1] = shape;
    const inColumns = Float32Array.from({ length: values.length }, (_, at) => {
      const [frame, column, row] = [Math.floor(at / (rows * columns)) % frames, Math.floor(at / rows) % columns, at % rows];
      return values[(frame * rows + row) * columns + column];
    });
    return element(MATRIX, Buffer.concat([element(UINT32, words([SINGLE, 0])), element(INT32, words(shape)),
      element(INT8, Buffer.from(name)), element(SINGLE, Buffer.from(inColumns.buffer))]));
  })]);
}

/** An npy file of little-endian float32. */
function npy(shape, values) {
  const text = `{'descr': '<f4', 'fortran_order': False, 'shape': (${shape.join(", ")}), }`;
  const header = `${text.padEnd(Math.ceil((text.length + 11) / 64) * 64 - 11)}\n`;
  const start = Buffer.from([0x93, 0x4e, 0x55, 0x4d, 0x50, 0x59, 1, 0, header.length & 255, header.length >> 8]);
  return Buffer.concat([start, Buffer.from(header, "latin1"), Buffer.from(values.buffer)]);
}
