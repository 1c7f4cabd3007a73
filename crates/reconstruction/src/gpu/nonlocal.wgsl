// Kernels of the nonlocal prior (priors/nonlocal has the equations).
//
// Clips are in standard layout with axes (frame, row, column). Every sum has a fixed order, so results are the same in each run.

struct Settings {
    width: u32,
    height: u32,
    frames: u32,
    // Patch positions of a search window, down and to the right.
    window_rows: u32,
    window_columns: u32,
    groups: u32,
    // Distance by which a pixel may exceed the range of its neighbours.
    margin: f32,
    // Square of the level of temporal shrinkage; 0 for none.
    level: f32,
    tau: f32,
    // Rows of all frames that a band aggregates, from the first to the one after the last.
    first_row: u32,
    end_row: u32,
}

@group(0) @binding(0) var<uniform> settings: Settings;
// The clip that the projection made, and in the end the result.
@group(0) @binding(1) var<storage, read_write> frames: array<f32>;
@group(0) @binding(2) var<storage, read_write> noisy: array<f32>;
// The previous result, in which patches are compared.
@group(0) @binding(3) var<storage, read_write> guide: array<f32>;
// The DCT along time without its constant row [B-1,B].
@group(0) @binding(4) var<storage, read> cosines: array<f32>;
// Coefficients along time [B-1,H,W].
@group(0) @binding(5) var<storage, read_write> coefficients: array<f32>;
// For each group the place of its reference, the first frame of the search, and the first patch of the window in each frame.
@group(0) @binding(6) var<storage, read> windows: array<u32>;
// Top left pixels of the patches of each group.
@group(0) @binding(7) var<storage, read_write> groups: array<u32>;
// The filtered patches of the groups of a band.
@group(0) @binding(8) var<storage, read_write> patches: array<f32>;
// For each place of a band the end of its entries; then the entries, indices of patches in the order of their places.
@group(0) @binding(9) var<storage, read> entries: array<u32>;
// The groups of a band.
@group(0) @binding(10) var<storage, read> members: array<u32>;

const GROUP = 256u;
const SIDE = 6u;
const PIXELS = 36u;
const PATCHES = 40u;
const WINDOW = 256u;
const REACHED = 7u;
const CANDIDATES = WINDOW * REACHED;
const RADIUS = 2u;
const NONE = 0xffffffffu;

fn index(id: vec3<u32>, grid: vec3<u32>, lane: u32) -> u32 {
    return (id.y * grid.x + id.x) * GROUP + lane;
}

fn reflect(at: u32, step: u32, length: u32) -> u32 {
    let beside = at + step;
    if beside == 0u {
        return 1u;
    }
    return select(beside - 1u, length - 2u, beside > length);
}

// Clamps each pixel to the range of its eight neighbours, extended by the margin.
@compute @workgroup_size(256)
fn limit_outliers(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let voxel = index(id, grid, lane);
    let plane = settings.width * settings.height;
    if voxel >= plane * settings.frames {
        return;
    }
    let frame = voxel / plane * plane;
    let row = voxel % plane / settings.width;
    let column = voxel % settings.width;
    var least = 3.0e38;
    var greatest = -3.0e38;
    for (var step = 0u; step < 9u; step++) {
        if step != 4u {
            let i = reflect(row, step / 3u, settings.height);
            let j = reflect(column, step % 3u, settings.width);
            let value = frames[frame + i * settings.width + j];
            least = min(least, value);
            greatest = max(greatest, value);
        }
    }
    noisy[voxel] = min(max(frames[voxel], least - settings.margin), greatest + settings.margin);
}

// The coefficients along time of a pixel.
@compute @workgroup_size(256)
fn analyse(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let plane = settings.width * settings.height;
    let at = index(id, grid, lane);
    if at >= plane * (settings.frames - 1u) {
        return;
    }
    let first = at / plane * settings.frames;
    var sum = 0.0;
    for (var k = 0u; k < settings.frames; k++) {
        sum += cosines[first + k] * noisy[k * plane + at % plane];
    }
    coefficients[at] = sum;
}

// Subtracts the excess of the coefficients of a pixel.
@compute @workgroup_size(256)
fn shrink(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let plane = settings.width * settings.height;
    let at = index(id, grid, lane);
    if at >= plane {
        return;
    }
    let row = at / settings.width;
    let column = at % settings.width;
    let top = max(row, RADIUS) - RADIUS;
    let bottom = min(row + RADIUS + 1u, settings.height);
    let left = max(column, RADIUS) - RADIUS;
    let right = min(column + RADIUS + 1u, settings.width);
    let scale = 1.0 / (f32((bottom - top) * (right - left)) * settings.level);
    for (var m = 0u; m + 1u < settings.frames; m++) {
        var energy = 0.0;
        for (var i = top; i < bottom; i++) {
            for (var j = left; j < right; j++) {
                let value = coefficients[m * plane + i * settings.width + j];
                energy += value * value;
            }
        }
        let ratio = energy * scale;
        let excess = coefficients[m * plane + at] / (1.0 + ratio * ratio);
        for (var k = 0u; k < settings.frames; k++) {
            noisy[k * plane + at] -= cosines[m * settings.frames + k] * excess;
        }
    }
}

var<workgroup> keys: array<u32, CANDIDATES>;
var<workgroup> counts: array<u32, GROUP>;

// Sums over the lanes up to each one, which then are in `counts`.
fn accumulate(lane: u32, count: u32) {
    workgroupBarrier();
    counts[lane] = count;
    for (var reach = 1u; reach < GROUP; reach *= 2u) {
        workgroupBarrier();
        var sum = counts[lane];
        if lane >= reach {
            sum += counts[lane - reach];
        }
        workgroupBarrier();
        counts[lane] = sum;
    }
    workgroupBarrier();
}

fn place_of(group: u32, candidate: u32) -> u32 {
    let start = windows[group * (REACHED + 1u) + 1u + candidate / WINDOW];
    let at = candidate % WINDOW;
    return start + at / settings.window_columns * settings.width + at % settings.window_columns;
}

// Finds the patches nearest to a reference, in the order of their places; equal ones are taken from the first.
@compute @workgroup_size(256)
fn search(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let group = id.y * grid.x + id.x;
    if group >= settings.groups {
        return;
    }
    let first = group * (REACHED + 1u);
    let reference = windows[first];
    let size = settings.window_rows * settings.window_columns;
    for (var k = 0u; k < REACHED; k++) {
        // Above all bits of a distance.
        var key = NONE;
        if lane < size && windows[first + 1u + k] != NONE {
            let place = place_of(group, k * WINDOW + lane);
            var sum = 0.0;
            for (var i = 0u; i < SIDE; i++) {
                for (var j = 0u; j < SIDE; j++) {
                    let offset = i * settings.width + j;
                    let difference = guide[place + offset] - guide[reference + offset];
                    sum = fma(difference, difference, sum);
                }
            }
            key = select(bitcast<u32>(sum) + 1u, 0u, place == reference);
        }
        keys[k * WINDOW + lane] = key;
    }
    workgroupBarrier();
    // The largest bound with fewer than PATCHES keys below it, bit by bit.
    var bound = 0u;
    for (var bit = 31u; bit < 32u; bit--) {
        let tried = bound | (1u << bit);
        var count = 0u;
        for (var k = 0u; k < REACHED; k++) {
            count += u32(keys[k * WINDOW + lane] < tried);
        }
        accumulate(lane, count);
        if counts[GROUP - 1u] < PATCHES {
            bound = tried;
        }
        workgroupBarrier();
    }
    // Seven consecutive candidates for each lane.
    var below = 0u;
    var equal = 0u;
    for (var k = 0u; k < REACHED; k++) {
        let key = keys[lane * REACHED + k];
        below += u32(key < bound);
        equal += u32(key == bound && key != NONE);
    }
    // Both counts are at most 1792, so that they share 32 bits.
    accumulate(lane, below | (equal << 16u));
    let total = counts[GROUP - 1u] & 0xffffu;
    var equals_before = (counts[lane] >> 16u) - equal;
    let room = PATCHES - total;
    var slot = (counts[lane] & 0xffffu) - below + min(equals_before, room);
    let found = total + min(counts[GROUP - 1u] >> 16u, room);
    for (var k = 0u; k < REACHED; k++) {
        let candidate = lane * REACHED + k;
        let key = keys[candidate];
        var taken = key < bound;
        if key == bound && key != NONE {
            taken = equals_before < room;
            equals_before++;
        }
        if taken {
            groups[group * PATCHES + slot] = place_of(group, candidate);
            slot++;
        }
    }

    // A clip too small for a full group repeats its patches.
    if lane >= found && lane < PATCHES {
        groups[group * PATCHES + lane] = NONE;
    }
}

// The centred patches, then the solution [PIXELS,PATCHES].
var<workgroup> solved: array<f32, 1440>;
var<workgroup> gram: array<f32, 1296>;
var<workgroup> lower: array<f32, 1296>;

const LANES = 64u;

// Y - tau^2 (G^2 + tau^2)^-1 (Y - mean) of a group, with G = (Y - mean) (Y - mean)^T.
@compute @workgroup_size(64)
fn low_rank(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let slot = id.y * grid.x + id.x;
    if slot >= settings.groups {
        return;
    }
    let group = members[slot];
    if lane < PATCHES {
        let place = groups[group * PATCHES + lane];
        for (var p = 0u; p < PIXELS; p++) {
            solved[p * PATCHES + lane] = noisy[place + p / SIDE * settings.width + p % SIDE];
        }
    }
    workgroupBarrier();
    if lane < PIXELS {
        var sum = 0.0;
        for (var n = 0u; n < PATCHES; n++) {
            sum += solved[lane * PATCHES + n];
        }
        let mean = sum * (1.0 / f32(PATCHES));
        for (var n = 0u; n < PATCHES; n++) {
            solved[lane * PATCHES + n] -= mean;
        }
    }
    workgroupBarrier();
    for (var at = lane; at < PIXELS * PIXELS; at += LANES) {
        let i = at / PIXELS;
        let j = at % PIXELS;
        var sum = 0.0;
        for (var n = 0u; n < PATCHES; n++) {
            sum = fma(solved[i * PATCHES + n], solved[j * PATCHES + n], sum);
        }
        gram[at] = sum;
    }
    workgroupBarrier();
    var trace = 0.0;
    for (var i = 0u; i < PIXELS; i++) {
        trace += gram[i * PIXELS + i];
    }
    let square = max(settings.tau * settings.tau, 4e-6 * trace * trace);
    for (var at = lane; at < PIXELS * PIXELS; at += LANES) {
        let i = at / PIXELS;
        let j = at % PIXELS;
        var sum = select(0.0, square, i == j);
        for (var n = 0u; n < PIXELS; n++) {
            sum = fma(gram[i * PIXELS + n], gram[j * PIXELS + n], sum);
        }
        lower[at] = sum;
    }
    // The Cholesky factor with the reciprocals of its diagonal, column by column.
    for (var j = 0u; j < PIXELS; j++) {
        workgroupBarrier();
        var value = 0.0;
        if lane >= j && lane < PIXELS {
            value = lower[lane * PIXELS + j];
            for (var n = 0u; n < j; n++) {
                value = fma(-lower[lane * PIXELS + n], lower[j * PIXELS + n], value);
            }
        }
        if lane == j {
            // The pivots of a sum with tau^2 are at least tau^2, up to rounding.
            lower[j * PIXELS + j] = 1.0 / sqrt(max(value, 0.1 * square));
        }
        workgroupBarrier();
        if lane > j && lane < PIXELS {
            lower[lane * PIXELS + j] = value * lower[j * PIXELS + j];
        }
    }
    workgroupBarrier();
    if lane >= PATCHES {
        return;
    }
    for (var i = 0u; i < PIXELS; i++) {
        var value = solved[i * PATCHES + lane];
        for (var n = 0u; n < i; n++) {
            value = fma(-lower[i * PIXELS + n], solved[n * PATCHES + lane], value);
        }
        solved[i * PATCHES + lane] = value * lower[i * PIXELS + i];
    }
    let place = groups[group * PATCHES + lane];
    for (var back = 0u; back < PIXELS; back++) {
        let i = PIXELS - 1u - back;
        var value = solved[i * PATCHES + lane];
        for (var n = i + 1u; n < PIXELS; n++) {
            value = fma(-lower[n * PIXELS + i], solved[n * PATCHES + lane], value);
        }
        value *= lower[i * PIXELS + i];
        solved[i * PATCHES + lane] = value;
        let pixel = noisy[place + i / SIDE * settings.width + i % SIDE];
        patches[(slot * PATCHES + lane) * PIXELS + i] = pixel - square * value;
    }
}

// The mean of the filtered patches at a pixel of a band, place by place and group by group.
@compute @workgroup_size(256)
fn aggregate(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let at = index(id, grid, lane);
    let rows = settings.end_row - settings.first_row;
    if at >= rows * settings.width * settings.frames {
        return;
    }
    let frame = at / (rows * settings.width);
    let row = settings.first_row + at / settings.width % rows;
    let column = at % settings.width;
    // The places of a band begin with those of the patches that reach its first row.
    let top = max(settings.first_row, SIDE - 1u) - (SIDE - 1u);
    let place_rows = settings.end_row - top;
    let count = place_rows * settings.width * settings.frames;
    var sum = 0.0;
    var cover = 0u;
    for (var i = 0u; i <= min(row, SIDE - 1u); i++) {
        for (var j = 0u; j <= min(column, SIDE - 1u); j++) {
            let place = (frame * place_rows + row - top - i) * settings.width + column - j;
            var first = 0u;
            if place > 0u {
                first = entries[place - 1u];
            }
            for (var entry = first; entry < entries[place]; entry++) {
                sum += patches[entries[count + entry] * PIXELS + i * SIDE + j];
                cover++;
            }
        }
    }
    let value = sum / f32(cover);
    let voxel = (frame * settings.height + row) * settings.width + column;
    frames[voxel] = value;
    guide[voxel] = value;
}
