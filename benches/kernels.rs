//! Cost of the kernels, single thread: `cargo bench --bench kernels`.
//!
//! Criterion's throughput is in voxels: ns per voxel = 1 / throughput. A total-variation row names
//! its dual updates; divide by their number for the cost of one. The rows named roofline show the
//! limits of the machine: the same number of operations on registers only, and the same memory
//! traffic without arithmetic.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use ndarray::Array3;
use rand::{RngExt, SeedableRng};
use reconstruction::operator::SensingOperator;
use reconstruction::priors::nonlocal::{Nonlocal, Part};
use reconstruction::priors::temporal::TemporalVariation;
use reconstruction::priors::tv::TotalVariation;
use reconstruction::schedule::Schedule;
use reconstruction::solver::reconstruct;
use std::hint::black_box;

const DIM: (usize, usize, usize) = (8, 256, 256);
const ITERATIONS: usize = 40;
/// Values per register, and enough registers to hide the latency of an operation.
const LANES: usize = 16;
const CHAINS: usize = 10;

fn random(seed: u64) -> Array3<f32> {
    let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(seed);
    Array3::from_shape_fn(DIM, |_| rng.random::<f32>())
}

fn kernels(criterion: &mut Criterion) {
    let voxels = (DIM.0 * DIM.1 * DIM.2) as u64;
    let mut group = criterion.benchmark_group("8x256x256");
    group.sample_size(20);

    group.throughput(Throughput::Elements(voxels));
    for updates in [1, 4, 20] {
        let mut tv = TotalVariation::new(DIM);
        let mut frames = random(1);
        group.bench_function(format!("tv, {updates} dual updates"), |bencher| {
            bencher.iter(|| tv.denoise(black_box(&mut frames), 0.1, updates));
        });
    }

    let mut temporal = TemporalVariation::new(DIM.0);
    let mut frames = random(1);
    group.bench_function("tv along time, 4 dual updates", |bencher| {
        bencher.iter(|| temporal.denoise(black_box(&mut frames), 0..DIM.1, 0.004, 4));
    });

    let op = SensingOperator::new(random(2)).expect("random masks are valid");
    let y = op.forward(random(3).view()).expect("sizes agree");
    group.throughput(Throughput::Elements(voxels * ITERATIONS as u64));
    group.bench_function(format!("gap-tv, {ITERATIONS} iterations"), |bencher| {
        let schedule = Schedule::gap_tv().with_iterations(ITERATIONS);
        bencher.iter(|| reconstruct(&op, black_box(y.view()), &schedule, &mut (), &mut ()));
    });
    // A dual update has 26 operations per voxel: 22 for the dual field, 4 for the primal one.
    group.throughput(Throughput::Elements(voxels));
    group.bench_function("roofline, arithmetic of 4 dual updates", |bencher| {
        bencher.iter(|| operations(black_box(4 * 26 * DIM.0 * DIM.1 * DIM.2)));
    });
    // An iteration of GAP-TV reads frames and masks, and writes frames.
    let (frames, masks, mut out) = (random(4), random(5), random(6));
    group.bench_function("roofline, memory of a gap-tv iteration", |bencher| {
        bencher
            .iter(|| ndarray::azip!((out in &mut out, &a in &frames, &b in &masks) *out = a + b));
    });
    group.finish();
    nonlocal(criterion);
}

/// The parts of the nonlocal prior. A part with arithmetic is compared with its operations on
/// registers only; a part that only moves numbers, with the same memory traffic: a load and a store
/// per number.
fn nonlocal(criterion: &mut Criterion) {
    const PIXELS: usize = 36;
    const PATCHES: usize = 40;
    let mut group = criterion.benchmark_group("nonlocal 8x256x256");
    group.sample_size(10);
    group.throughput(Throughput::Elements((DIM.0 * DIM.1 * DIM.2) as u64));
    let mut prior = Nonlocal::new(DIM);
    let mut frames = random(7);
    group.bench_function("four passes", |bencher| {
        bencher.iter(|| (0..4).for_each(|_| prior.denoise(black_box(&mut frames), 0.05, 0.35)));
    });
    for part in Part::ALL {
        let name = format!("{part:?}").to_lowercase();
        group
            .bench_function(&name, |bencher| bencher.iter(|| prior.work(black_box(&[part]), 0.05)));
    }
    // Every fifth pixel, including both ends.
    let groups = DIM.0 * 51 * 51;
    // 44 pairs of frames at a distance of at most 3, of 8 x 8 pixels; a difference and a square per
    // pixel.
    let candidates = 44 * 51 * 51 * 16 * 16;
    let triangle = |size: usize| size * (size + 1) / 2;
    let square = PIXELS * PIXELS;
    for (part, count) in [
        ("search", candidates * PIXELS * 2),
        ("gram", groups * triangle(PIXELS) * PATCHES),
        ("factor", groups * (triangle(PIXELS) * PIXELS + square * PIXELS / 6)),
        ("solve", groups * square * PATCHES),
    ] {
        group.bench_function(format!("roofline, arithmetic of {part}"), |bencher| {
            bencher.iter(|| operations(black_box(count)));
        });
    }
    let (from, mut to) = (vec![1.0f32; PIXELS * PATCHES], vec![0.0f32; PIXELS * PATCHES]);
    group.bench_function("roofline, memory of gather or scatter", |bencher| {
        bencher.iter(|| {
            for _ in 0..groups {
                black_box(&from).iter().zip(black_box(&mut to)).for_each(|(from, to)| *to = *from);
            }
        });
    });
    group.finish();
}

/// Performs `count` fused multiply-adds on independent registers.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl+fma", "x86_64+avx2+fma"))]
fn operations(count: usize) -> [[f32; LANES]; CHAINS] {
    let mut chains = [[0.5f32; LANES]; CHAINS];
    for _ in 0..count / (LANES * CHAINS) {
        for chain in &mut chains {
            for value in chain {
                *value = if multiversion::target::target_cfg_f!(target_feature = "fma") {
                    value.mul_add(0.999, 0.001)
                } else {
                    *value * 0.999 + 0.001
                };
            }
        }
    }
    chains
}

criterion_group!(benches, kernels);
criterion_main!(benches);
