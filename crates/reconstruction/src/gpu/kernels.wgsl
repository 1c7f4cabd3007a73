// Kernels of one iteration with total variation (gap.rs, admm.rs, priors/tv.rs and priors/temporal.rs have the equations).
//
// Arrays are in standard layout with axes (frame, row, column). Sums have a fixed order, so results are the same in each
// run. An iteration after convergence does nothing: the host reads sums only once in several iterations.

struct Settings {
    width: u32,
    height: u32,
    // Frames of one snapshot, and of all snapshots.
    frames: u32,
    all_frames: u32,
    // Workgroups of `project`, and of `variation`.
    pixel_groups: u32,
    block_groups: u32,
    flags: u32,
    // Dual updates of this dispatch.
    updates: u32,
    // Step of the dual ascent over the weight of total variation.
    step: f32,
    temporal_weight: f32,
    memory: f32,
    momentum: f32,
    tolerance: f32,
}

const ACCELERATED = 1u;
const ADMM = 2u;
const EXTRAPOLATED = 4u;
// The first and the last of the dispatches that make the dual updates of one iteration.
const FIRST = 8u;
const LAST = 16u;

const TAU = 0.25;
const MIN_SQUARE = 1e-30;

@group(0) @binding(0) var<uniform> settings: Settings;
// Number of iterations done, 1 after convergence, two unused values; for each iteration of a batch the squared residual,
// change and norm, and 1 at convergence; then one residual for each workgroup of `project`, and the two others for each
// workgroup of `variation`.
@group(0) @binding(1) var<storage, read_write> sums: array<f32>;
// The masks C [B,H,W].
@group(0) @binding(2) var<storage, read> masks: array<f32>;
// y, (H R H^T + gamma)^-1 and y1, each [S,H,W].
@group(0) @binding(3) var<storage, read_write> pixels: array<f32>;
// The frames [S B,H,W] that are measured: w, or v if there is no w.
@group(0) @binding(4) var<storage, read> start: array<f32>;
// The projected frames; with ADMM, u is subtracted.
@group(0) @binding(5) var<storage, read_write> x: array<f32>;
// The multiplier of ADMM; between `project` and `variation` a copy of x.
@group(0) @binding(6) var<storage, read_write> u: array<f32>;
@group(0) @binding(7) var<storage, read_write> v: array<f32>;
@group(0) @binding(8) var<storage, read_write> w: array<f32>;
// Dual fields (down, right) from the dispatch before, and for the next one.
@group(0) @binding(9) var<storage, read> dual_before: array<vec2<f32>>;
@group(0) @binding(10) var<storage, read_write> dual_after: array<vec2<f32>>;
// Dual field along time.
@group(0) @binding(11) var<storage, read_write> field: array<f32>;
// R C [B,H,W]; the masks if R = 1.
@group(0) @binding(12) var<storage, read> directions: array<f32>;
// Hold-out pixels, by their index in [S,H,W].
@group(0) @binding(13) var<storage, read> held_out: array<u32>;
// (y - H v)^2 of each of them.
@group(0) @binding(14) var<storage, read_write> squares: array<f32>;

const GROUP = 256u;
const BATCH = 32u;
const PARTS = 4u + 4u * BATCH;

fn has(flag: u32) -> bool {
    return (settings.flags & flag) != 0u;
}

var<workgroup> stopped: f32;

fn has_stopped(lane: u32) -> bool {
    if lane == 0u {
        stopped = sums[1];
    }
    return workgroupUniformLoad(&stopped) > 0.0;
}

var<workgroup> lanes: array<f32, GROUP>;

// Sum over a workgroup, in a fixed order; valid in lane 0.
fn total(lane: u32, value: f32) -> f32 {
    workgroupBarrier();
    lanes[lane] = value;
    for (var reach = GROUP / 2u; reach > 0u; reach /= 2u) {
        workgroupBarrier();
        if lane < reach {
            lanes[lane] += lanes[lane + reach];
        }
    }
    return lanes[0];
}

// x = w + R H^T (H R H^T + gamma)^-1 (y1 - H w), one measured pixel for each lane.
@compute @workgroup_size(256)
fn project(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    if has_stopped(lane) {
        return;
    }
    let group = id.y * grid.x + id.x;
    let pixel = group * GROUP + lane;
    let plane = settings.width * settings.height;
    let count = plane * (settings.all_frames / settings.frames);
    var square = 0.0;
    if group < settings.pixel_groups && pixel < count {
        let at = pixel % plane;
        let first = pixel / plane * settings.frames * plane + at;
        var measured = 0.0;
        for (var k = 0u; k < settings.frames; k++) {
            measured += masks[k * plane + at] * start[first + k * plane];
        }
        let y = pixels[pixel];
        square = (y - measured) * (y - measured);
        var aim = y;
        if has(ACCELERATED) {
            aim += settings.memory * (pixels[2u * count + pixel] - measured);
            pixels[2u * count + pixel] = aim;
        }
        let correction = (aim - measured) * pixels[count + pixel];
        for (var k = 0u; k < settings.frames; k++) {
            let voxel = first + k * plane;
            var value = start[voxel] + directions[k * plane + at] * correction;
            if has(ADMM) {
                value -= u[voxel];
                u[voxel] = value;
            }
            x[voxel] = value;
        }
    }
    let sum = total(lane, square);
    if lane == 0u && group < settings.pixel_groups {
        sums[PARTS + group] = sum;
    }
}

// Total variation along time, in place on x, one pixel of all frames for each lane.
@compute @workgroup_size(256)
fn variation_along_time(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let plane = settings.width * settings.height;
    let at = (id.y * grid.x + id.x) * GROUP + lane;
    if has_stopped(lane) || at >= plane {
        return;
    }
    let end = settings.all_frames * plane;
    for (var update = 0u; update < settings.updates; update++) {
        // u of the frame before, and the dual field after it, both from before the update.
        var last = 0.0;
        var before = 0.0;
        for (var voxel = at; voxel < end; voxel += plane) {
            let after = select(field[voxel], 0.0, update == 0u);
            let here = x[voxel] - after + before;
            if voxel > at {
                let moved = before - TAU * (here - last);
                field[voxel - plane] =
                    clamp(moved, -settings.temporal_weight, settings.temporal_weight);
            }
            last = here;
            before = after;
        }
        field[end - plane + at] = 0.0;
    }
    var before = 0.0;
    for (var voxel = at; voxel < end; voxel += plane) {
        let after = field[voxel];
        x[voxel] += before - after;
        before = after;
    }
}

// Side of the block that a workgroup computes. Each dual update spoils one pixel at its edges, so MARGIN allows for four
// updates from 0, and for three from stored fields.
const SIDE = 32u;
const MARGIN = 4u;
const INNER = SIDE - 2u * MARGIN;
// Rows of a workgroup, and pixels of each lane.
const ROWS = 8u;
const SHARE = SIDE / ROWS;

var<workgroup> primal: array<f32, SIDE * SIDE>;
var<workgroup> down: array<f32, SIDE * SIDE>;
var<workgroup> right: array<f32, SIDE * SIDE>;

// u = x + div p at a pixel of the block.
fn ascended(value: f32, row: u32, column: u32) -> f32 {
    let cell = row * SIDE + column;
    var result = value - down[cell] - right[cell];
    if row > 0u {
        result += down[cell - SIDE];
    }
    if column > 0u {
        result += right[cell - 1u];
    }
    return result;
}

// Total variation of each frame, by dual updates in workgroup memory. The last dispatch of an iteration writes v and w.
@compute @workgroup_size(32, 8)
fn variation(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    if has_stopped(lane) {
        return;
    }
    let height = i32(settings.height);
    let width = i32(settings.width);
    let column = local.x;
    let j = i32(id.x * INNER + column) - i32(MARGIN);
    let top = i32(id.y * INNER) - i32(MARGIN);
    let frame = id.z * settings.width * settings.height;
    var values: array<f32, SHARE>;
    for (var part = 0u; part < SHARE; part++) {
        let row = part * ROWS + local.y;
        let i = top + i32(row);
        var dual = vec2<f32>(0.0);
        values[part] = 0.0;
        if i >= 0 && i < height && j >= 0 && j < width {
            let voxel = frame + u32(i * width + j);
            values[part] = x[voxel];
            if !has(FIRST) {
                dual = dual_before[voxel];
            }
        }
        down[row * SIDE + column] = dual.x;
        right[row * SIDE + column] = dual.y;
    }
    workgroupBarrier();
    for (var update = 0u; update < settings.updates; update++) {
        for (var part = 0u; part < SHARE; part++) {
            let row = part * ROWS + local.y;
            primal[row * SIDE + column] = ascended(values[part], row, column);
        }
        workgroupBarrier();
        for (var part = 0u; part < SHARE; part++) {
            let row = part * ROWS + local.y;
            let cell = row * SIDE + column;
            let i = top + i32(row);
            var gradient = vec2<f32>(0.0);
            if i >= 0 && i < height && j >= 0 && j < width {
                if i + 1 < height && row + 1u < SIDE {
                    gradient.x = primal[cell + SIDE] - primal[cell];
                }
                if j + 1 < width && column + 1u < SIDE {
                    gradient.y = primal[cell + 1u] - primal[cell];
                }
            }
            let norm = sqrt(dot(gradient, gradient) + MIN_SQUARE);
            let scale = 1.0 / (1.0 + settings.step * norm);
            down[cell] = (down[cell] - TAU * gradient.x) * scale;
            right[cell] = (right[cell] - TAU * gradient.y) * scale;
        }
        workgroupBarrier();
    }
    var difference = 0.0;
    var norm = 0.0;
    for (var part = 0u; part < SHARE; part++) {
        let row = part * ROWS + local.y;
        let i = top + i32(row);
        let is_inner = row >= MARGIN && row < MARGIN + INNER && column >= MARGIN && column < MARGIN + INNER;
        if !is_inner || i >= height || j >= width {
            continue;
        }
        let voxel = frame + u32(i * width + j);
        if !has(LAST) {
            dual_after[voxel] = vec2<f32>(down[row * SIDE + column], right[row * SIDE + column]);
            continue;
        }
        let value = ascended(values[part], row, column);
        let change = value - v[voxel];
        difference += change * change;
        norm += value * value;
        var ahead = value + settings.momentum * change;
        if has(ADMM) {
            let multiplier = value - u[voxel];
            u[voxel] = multiplier;
            ahead += multiplier;
        }
        if has(EXTRAPOLATED) {
            w[voxel] = ahead;
        }
        v[voxel] = value;
    }
    if !has(LAST) {
        return;
    }
    let differences = total(lane, difference);
    let norms = total(lane, norm);
    if lane == 0u {
        let place = PARTS + settings.pixel_groups + 2u * ((id.z * grid.y + id.y) * grid.x + id.x);
        sums[place] = differences;
        sums[place + 1u] = norms;
    }
}

// Adds the parts of the sums, and decides whether the iteration has converged. One workgroup.
@compute @workgroup_size(256)
fn finish(@builtin(local_invocation_index) lane: u32) {
    if has_stopped(lane) {
        return;
    }
    var parts = vec3<f32>(0.0);
    for (var group = lane; group < settings.pixel_groups; group += GROUP) {
        parts.x += sums[PARTS + group];
    }
    for (var group = lane; group < settings.block_groups; group += GROUP) {
        let place = PARTS + settings.pixel_groups + 2u * group;
        parts += vec3<f32>(0.0, sums[place], sums[place + 1u]);
    }
    let residual = total(lane, parts.x);
    let difference = total(lane, parts.y);
    let norm = total(lane, parts.z);
    if lane != 0u {
        return;
    }
    let bound = settings.tolerance * settings.tolerance * norm;
    let converged = settings.tolerance > 0.0 && (difference < bound || difference == 0.0);
    let place = 4u + 4u * u32(sums[0]);
    sums[place] = residual;
    sums[place + 1u] = difference;
    sums[place + 2u] = norm;
    sums[place + 3u] = select(0.0, 1.0, converged);
    sums[0] += 1.0;
    sums[1] = sums[place + 3u];
}

// The squared residual of each hold-out pixel.
@compute @workgroup_size(256)
fn hold_out(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let slot = (id.y * grid.x + id.x) * GROUP + lane;
    if slot >= arrayLength(&held_out) {
        return;
    }
    let pixel = held_out[slot];
    let plane = settings.width * settings.height;
    let at = pixel % plane;
    let first = pixel / plane * settings.frames * plane + at;
    var measured = 0.0;
    for (var k = 0u; k < settings.frames; k++) {
        measured += masks[k * plane + at] * start[first + k * plane];
    }
    let residual = pixels[pixel] - measured;
    squares[slot] = residual * residual;
}
