//! Runs the embedded networks with ONNX Runtime through the denoisers of the reconstruction.

#![allow(clippy::unwrap_used)] // test helpers

use std::path::PathBuf;

use ndarray::{Array3, ArrayView3, Axis, s};
use optics::{iid_masks, measure};
use rand::{RngExt, SeedableRng};
use reconstruction::cores::Cores;
use reconstruction::priors::network::ClipDenoiser;
use reconstruction::priors::onnx::{Device, Runtime};
use reconstruction::priors::{CHANNELS, Denoiser, Network, Networks};
use reconstruction::schedule::Schedule;
use reconstruction::sequence::SequencePlan;
use reconstruction::tile::TilePlan;
use sci_recon_engine::job::Algorithm;
use sci_recon_engine::pipeline::networks::{self, NetworkSource, WarmNetworks};
use sci_recon_engine::pipeline::sequence::{SequenceInput, Solver, solve};

/// Path of libonnxruntime, or none after a message. With `CI=true` in the environment, the test fails instead.
fn library() -> Option<PathBuf> {
    let library = std::env::var_os("ORT_DYLIB_PATH").map(PathBuf::from).filter(|p| p.exists());
    if library.is_none() {
        let missing = "ORT_DYLIB_PATH names no libonnxruntime: run `make runtime`";
        let required = std::env::var("CI").is_ok_and(|value| value == "true");
        assert!(!required, "no test may be skipped with CI=true, but {missing}");
        eprintln!("SKIPPED: {missing}");
    }
    library
}

fn load(which: Network) -> Option<ClipDenoiser> {
    load_for(which, &Cores::default())
}

fn load_for(which: Network, cores: &Cores) -> Option<ClipDenoiser> {
    let runtime = Runtime::open(&library()?, Device::Cpu).unwrap().with_cores(cores.clone());
    let files = networks::carried(which).files.iter().map(|(_, file)| (*file).into());
    Some(ClipDenoiser::load(&runtime, which, files).unwrap())
}

fn noisy(frames: usize, height: usize, width: usize) -> (Array3<f32>, Array3<f32>) {
    let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(9);
    let clean = Array3::from_shape_fn((frames, height, width), |(k, i, j)| {
        0.5 + 0.3 * ((i + 2 * k) as f32 * 0.15).sin() * (j as f32 * 0.1).cos()
    });
    let noisy = clean.mapv(|x: f32| x + 0.35 * (rng.random::<f32>() - 0.5));
    (clean, noisy)
}

fn mean_square(a: &Array3<f32>, b: &Array3<f32>) -> f32 {
    (a - b).mapv(|d| d * d).mean().unwrap()
}

#[test]
fn noise_is_reduced_for_any_size_and_number_of_frames() {
    let Some(mut network) = load(Network::FastDvdNet) else { return };
    for (frames, height, width) in [(1, 32, 32), (2, 33, 46), (7, 50, 31)] {
        let (clean, mut video) = noisy(frames, height, width);
        let before = mean_square(&video, &clean);
        network.denoise(&mut video, 0.1).unwrap();
        let after = mean_square(&video, &clean);
        assert!(after < 0.2 * before, "{frames}x{height}x{width}: {before} to {after}");
    }
}

#[test]
fn frames_do_not_depend_on_the_batches_of_the_clip() {
    let Some(mut network) = load(Network::FastDvdNet) else { return };
    // At 300x300 a batch has two frames. The middle one of 9 frames depends only on its 4 neighbours.
    let (_, video) = noisy(9, 300, 300);
    let mut long = video.clone();
    network.denoise(&mut long, 0.1).unwrap();
    let mut short = video.slice(s![2..7, .., ..]).to_owned();
    network.denoise(&mut short, 0.1).unwrap();
    assert_eq!(long.slice(s![4, .., ..]), short.slice(s![2, .., ..]));
}

#[test]
fn networks_give_the_same_bits_on_any_number_of_cores() {
    for which in Network::ALL {
        let cores = Cores::default();
        let Some(mut network) = load_for(which, &cores) else { return };
        let (_, video) = noisy(4, 90, 110);
        let mut denoised = |count| {
            cores.set(count);
            let mut video = video.clone();
            network.denoise(&mut video, 0.1).unwrap();
            video
        };
        let alone = denoised(1);
        for count in [2, 3, 8, 1] {
            assert_eq!(denoised(count), alone, "{which:?} on {count} cores");
        }
    }
}

/// One tile with its pilot, by total variation, by the nonlocal prior, and by networks too.
#[test]
fn a_tile_has_the_same_bits_on_any_number_of_threads() {
    let (height, width) = (72, 80);
    let masks = iid_masks(5, height, width, 3).unwrap();
    let (frames, _) = noisy(5, height, width);
    let y = measure(masks.view(), frames.view()).unwrap().insert_axis(Axis(0));
    let (plan, runs) = (TilePlan::new(height, width, 96, 0).unwrap(), SequencePlan::separate(0..1));
    for algorithm in [Algorithm::GapTv, Algorithm::PnpNonlocal, Algorithm::PnpTvFastdvdnet] {
        let mut schedule: Schedule = algorithm.default_schedule();
        for stage in &mut schedule.stages {
            stage.iterations = stage.iterations.min(9);
        }
        let library = if schedule.needs_network() { library() } else { None };
        if schedule.needs_network() && library.is_none() {
            return;
        }
        let network = NetworkSource::new(library, Device::Cpu);
        let solved = |threads| {
            let solver = Solver::Schedule(&schedule);
            let (masks, measurement) = (masks.view(), y.view());
            let (plan, runs, mosaic) = (&plan, &runs, None);
            let white = 1.0;
            let input =
                SequenceInput { masks, measurement, first: 0, white, solver, plan, runs, mosaic };
            let mut solved = solve(&input, &network, threads, &|_, _| ()).unwrap();
            let tile = solved.runs.remove(0).remove(0);
            (tile.frames, tile.residual, tile.features, solved.pilot)
        };
        let (alone, shared) = (solved(1), solved(3));
        assert_eq!(shared.0, alone.0, "{algorithm:?}");
        assert_eq!((shared.1, shared.2), (alone.1, alone.2), "{algorithm:?}");
        assert_eq!(shared.3, alone.3, "{algorithm:?}");
    }
}

#[test]
fn encoder_features_depend_only_on_adjacent_blocks_and_frames() {
    let Some(library) = library() else { return };
    let source = NetworkSource::new(Some(library), Device::Cpu);
    let mut networks = WarmNetworks::new(source);
    let mut encode =
        |frames: ArrayView3<'_, f32>| networks.encoder().unwrap().unwrap().encode(frames).unwrap();
    let (clean, noisy) = noisy(9, 300, 290);
    let features = encode(noisy.view());
    assert_eq!(features.dim(), (CHANNELS, 9, 19, 19));
    let alone = encode(noisy.slice(s![3..6, .., ..]));
    let difference = &features.slice(s![.., 4, .., ..]) - &alone.slice(s![.., 1, .., ..]);
    assert!(difference.iter().all(|d| d.abs() < 1e-5));
    // The receptive field of a block extends at most 40 pixels beyond it.
    let mut half = clean.clone();
    half.slice_mut(s![.., .., ..128]).assign(&noisy.slice(s![.., .., ..128]));
    let change = (&encode(half.view()) - &encode(clean.view())).mapv(f32::abs);
    assert!(change.slice(s![.., .., .., ..8]).mean().unwrap() > 0.1);
    assert!(change.slice(s![.., .., .., 11..]).iter().all(|d| *d == 0.0));
}

#[test]
fn quantization_to_8_bits_changes_little() {
    let (Some(mut exact), Some(mut quick)) =
        (load(Network::FastDvdNet), load(Network::FastDvdNetInt8))
    else {
        return;
    };
    let (clean, mut frames) = noisy(6, 64, 64);
    let mut other = frames.clone();
    exact.denoise(&mut frames, 0.1).unwrap();
    quick.denoise(&mut other, 0.1).unwrap();
    let (error, change) = (mean_square(&frames, &clean), mean_square(&frames, &other));
    assert!(change > 0.0, "both networks have the same weights");
    // Measured: 12 %. The quantization range includes lights far above white (models/fastdvdnet-gray-int8/README.md).
    assert!(change < 0.2 * error, "{change} where the network's own error is {error}");
}
