//! The crop of a measurement on which decisions are tried.

use std::ops::Range;

use ndarray::{ArrayView2, s};

/// Side of the crop in pixels: a tenth of a tile.
pub const SIDE: usize = 96;

/// Side in pixels of the squares that a scene without texture and motion fills evenly.
const FLAT: usize = 8;

/// The rows and columns of the crop: among all that lie side by side in a measurement `y` \[H,W\], the one with the most
/// texture and motion. A flat region shows nothing, although its measurement varies too, with the sum of the masks, `light`
/// \[H,W\]. So the score of a crop is the energy that flat squares leave unexplained: the residual of `y = light x`, with
/// one `x` for each square.
pub fn choose(light: ArrayView2<'_, f32>, y: ArrayView2<'_, f32>) -> (Range<usize>, Range<usize>) {
    let (height, width) = y.dim();
    let starts = |length: usize| {
        let last = length.saturating_sub(SIDE);
        (0..last).step_by(SIDE).chain([last])
    };
    let window =
        |row: usize, column: usize| (row..height.min(row + SIDE), column..width.min(column + SIDE));
    let score = |(rows, columns): &(Range<usize>, Range<usize>)| {
        let window = s![rows.clone(), columns.clone()];
        let (light, y) = (light.slice(window), y.slice(window));
        let squares =
            light.exact_chunks((FLAT, FLAT)).into_iter().zip(y.exact_chunks((FLAT, FLAT)));
        squares.map(|(light, y)| flat_residual(light, y)).sum::<f64>()
    };
    starts(height)
        .flat_map(|row| starts(width).map(move |column| window(row, column)))
        .max_by(|a, b| score(a).total_cmp(&score(b)))
        .unwrap_or((0..height, 0..width))
}

/// `min_x ||y - light x||^2` over the measured pixels.
fn flat_residual(light: ArrayView2<'_, f32>, y: ArrayView2<'_, f32>) -> f64 {
    let (mut yy, mut ly, mut ll) = (0.0, 0.0, 0.0);
    for (&light, &y) in light.iter().zip(y).filter(|(_, y)| !y.is_nan()) {
        let (light, y) = (f64::from(light), f64::from(y));
        yy += y * y;
        ly += light * y;
        ll += light * light;
    }
    if ll > 0.0 { yy - ly * ly / ll } else { yy }
}

#[cfg(test)]
mod tests {
    use super::choose;
    use ndarray::{Array2, s};

    #[test]
    fn the_crop_has_the_most_texture_and_lies_inside() {
        let mut y = Array2::zeros((200, 300));
        y.slice_mut(s![150.., 250..]).assign(&Array2::from_shape_fn((50, 50), |(i, _)| i as f32));
        let light = Array2::ones((200, 300));
        assert_eq!(choose(light.view(), y.view()), (104..200, 204..300));
        // In a bright and flat region the measurement varies more, with the masks alone.
        let light = Array2::from_shape_fn((200, 300), |(i, j)| ((7 * i + 11 * j) % 5) as f32);
        y.slice_mut(s![..96, ..96]).assign(&(100.0 * &light.slice(s![..96, ..96])));
        assert_eq!(choose(light.view(), y.view()), (104..200, 204..300));
        let nothing = Array2::zeros((40, 60));
        assert_eq!(choose(nothing.view(), nothing.view()), (0..40, 0..60));
    }
}
