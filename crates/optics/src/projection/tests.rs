use ndarray::{Array2, array};
use rand::RngExt;

use super::{Method, Placement, Projector, centre};
use crate::{Geometry, generator};

fn random(size: (usize, usize), seed: u64) -> Array2<f32> {
    let mut rng = generator(seed);
    Array2::from_shape_simple_fn(size, || rng.random::<f32>())
}

/// Position, in micrometres along one axis, at which a ray crosses the mask plane, by ray transfer matrices. The ray
/// goes from height `aperture` in the front focal plane of the lens to height `image` in its back focal plane.
fn crossing_at_mask(geometry: &Geometry, aperture: f64, image: f64) -> f64 {
    let focal = geometry.focal_length_mm * 1000.0;
    let travel = |(height, slope): (f64, f64), length: f64| (height + slope * length, slope);
    let lens = |(height, slope): (f64, f64)| (height, slope - height / focal);
    let mask_plane = |slope: f64| {
        let after = lens(travel((aperture, slope), focal));
        travel(after, focal - geometry.mask_distance_um).0
    };
    let image_plane = |slope: f64| travel(lens(travel((aperture, slope), focal)), focal).0;
    // The image height is linear in the slope at the aperture, so two rays determine the slope.
    let (at_zero, at_one) = (image_plane(0.0), image_plane(1.0));
    mask_plane((image - at_zero) / (at_one - at_zero))
}

/// Light of a sensor pixel, by tracing `n^4` rays through each open cell.
fn trace(
    geometry: &Geometry,
    projector: &Projector,
    mask: &Array2<f32>,
    pattern: &Array2<f32>,
    (row, column): (usize, usize),
    n: usize,
) -> f64 {
    let sensor = geometry.sensor_pitch_um / geometry.magnification;
    let steps = || (0..n).map(|step| (step as f64 + 0.5) / n as f64);
    // Mask pixels along one axis, for all pairs of a point in the sensor pixel and a point in the cell.
    let hits = |pixel: usize, cell: usize, cells: usize, lcos: usize, phase: f64, origin: i64| {
        let size = lcos as f64 / cells as f64 * geometry.lcos_pitch_um;
        let mut hits = Vec::new();
        for at in steps() {
            let image = (pixel as f64 + at) * sensor + phase * geometry.mask_pitch_um;
            for within in steps() {
                let aperture = (cell as f64 + within - cells as f64 / 2.0) * size;
                let at = crossing_at_mask(geometry, aperture, image) / geometry.mask_pitch_um;
                hits.push((at.floor() as i64 - origin) as usize);
            }
        }
        hits
    };
    let (rows, columns) = pattern.dim();
    let mut light = 0.0;
    for ((r, c), &open) in pattern.indexed_iter() {
        let row_hits =
            hits(row, r, rows, geometry.lcos_rows, geometry.phase_rows, projector.rows.origin);
        let (lcos, phase) = (geometry.lcos_columns, geometry.phase_columns);
        let column_hits = hits(column, c, columns, lcos, phase, projector.columns.origin);
        let transmissions = row_hits
            .iter()
            .flat_map(|&i| column_hits.iter().map(move |&j| (i, j)))
            .map(|at| f64::from(mask[at]));
        light += f64::from(open) * transmissions.sum::<f64>()
            / (row_hits.len() * column_hits.len()) as f64;
    }
    light
}

#[test]
fn masks_agree_with_ray_tracing() {
    let paper = Geometry::default();
    let cases = [
        paper,
        Geometry { phase_rows: 0.35, phase_columns: -0.2, ..paper },
        Geometry { magnification: 2.0, phase_columns: 0.25, ..paper },
        Geometry { magnification: 1.5, mask_distance_um: 130.0, ..paper },
    ];
    for (index, geometry) in cases.into_iter().enumerate() {
        let pattern = random((3, 4), 1);
        let projector =
            Projector::new(&geometry, (3, 4), Placement::Geometric, Method::Convolution, (5, 7))
                .unwrap();
        let mask = random(projector.mask_size(), 2).mapv(f32::round);
        let projected = projector.project(mask.view(), pattern.view()).unwrap();
        for (row, column) in [(0, 0), (2, 3), (4, 6), (1, 4)] {
            let expected = trace(&geometry, &projector, &mask, &pattern, (row, column), 24);
            let actual = f64::from(projected[[row, column]]);
            assert!(
                (actual - expected).abs() < 0.02 * pattern.sum() as f64,
                "case {index}, pixel {row},{column}: {actual}, but {expected} by ray tracing"
            );
        }
    }
}

#[test]
fn whole_pixel_projection_sums_shifted_masks() {
    let geometry = Geometry::default();
    let projector =
        Projector::new(&geometry, (3, 4), Placement::WholePixels, Method::Shifts, (6, 8)).unwrap();
    assert_eq!(projector.mask_size(), (8, 11));
    let mask = random((8, 11), 3).mapv(f32::round);
    let pattern = array![[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
    let projected = projector.project(mask.view(), pattern.view()).unwrap();
    for ((row, column), &actual) in projected.indexed_iter() {
        let expected =
            mask[[row, column]] + mask[[row + 1, column + 2]] + mask[[row + 2, column + 3]];
        assert_eq!(actual, expected);
    }
}

#[test]
fn convolution_is_the_limit_of_many_shifts() {
    // 32x32 points approximate the area of a cell.
    let geometry = Geometry { magnification: 2.0, ..Geometry::default() };
    let coarse = random((3, 4), 5);
    let fine = Array2::from_shape_fn((96, 128), |(i, j)| coarse[[i / 32, j / 32]] / 1024.0);
    let project = |pattern: &Array2<f32>, method| {
        let cells = pattern.dim();
        let projector =
            Projector::new(&geometry, cells, Placement::Geometric, method, (20, 20)).unwrap();
        // The mask is a function of the coordinates, so both projectors see the same one.
        let at = |row: i64, column: i64| ((row * 7 + column * 13).rem_euclid(5)) as f32 / 4.0;
        let (rows, columns) = (projector.rows.origin, projector.columns.origin);
        let mask = Array2::from_shape_fn(projector.mask_size(), |(i, j)| {
            at(rows + i as i64, columns + j as i64)
        });
        projector.project(mask.view(), pattern.view()).unwrap()
    };
    let (area, points) = (project(&coarse, Method::Convolution), project(&fine, Method::Shifts));
    let largest = (&area - &points).iter().fold(0.0f32, |most, value| most.max(value.abs()));
    assert!(largest < 0.03, "{largest}");
}

#[test]
fn blur_reduces_contrast_but_not_light() {
    let deviation = |blur_um: f64| {
        let geometry = Geometry { blur_um, ..Geometry::default() };
        let method = Method::Shifts;
        let projector =
            Projector::new(&geometry, (3, 4), Placement::Geometric, method, (64, 64)).unwrap();
        let open = Array2::ones(projector.mask_size());
        let all = projector.project(open.view(), Array2::ones((3, 4)).view()).unwrap();
        assert!(all.iter().all(|value| (value - 12.0).abs() < 1e-3));
        let mask = random(projector.mask_size(), 6).mapv(f32::round);
        let mut one = Array2::zeros((3, 4));
        one[[1, 1]] = 1.0;
        projector.project(mask.view(), one.view()).unwrap().std(0.0)
    };
    let deviations = [0.0, 2.0, 4.5, 9.0].map(deviation);
    assert!(deviations.windows(2).all(|pair| pair[1] < 0.8 * pair[0]), "{deviations:?}");
}

#[test]
fn impossible_projections_are_refused() {
    let geometry = Geometry::default();
    let new = |cells, placement| {
        Projector::new(&geometry, cells, placement, Method::Shifts, (8, 8)).map(|_| ())
    };
    let error = new((12, 16), Placement::WholePixels).unwrap_err().to_string();
    assert!(error.contains("0.249 mask pixels"), "{error}");
    new((12, 16), Placement::Geometric).unwrap();
    let error = new((0, 4), Placement::Geometric).unwrap_err().to_string();
    assert!(error.contains("pattern rows is 0"), "{error}");
    let none = Geometry { mask_distance_um: 0.0, ..geometry };
    let error = Projector::new(&none, (3, 4), Placement::Geometric, Method::Shifts, (8, 8));
    assert!(error.unwrap_err().to_string().contains("mask distance_um is 0"));
    let projector =
        Projector::new(&geometry, (3, 4), Placement::Geometric, Method::Shifts, (8, 8)).unwrap();
    let mask = Array2::zeros(projector.mask_size());
    let error = projector.project(mask.view(), Array2::zeros((4, 3)).view()).unwrap_err();
    assert!(error.to_string().contains("has 4x3 cells"), "{error}");
}

#[test]
fn centre_takes_the_central_part() {
    let mask = Array2::from_shape_fn((5, 6), |(i, j)| (10 * i + j) as f32);
    assert_eq!(centre(mask.view(), (1, 2)), array![[22.0, 23.0]]);
    assert_eq!(centre(mask.view(), (5, 6)), mask);
}
