//! The patches of a picture on which masks are registered.

use std::ops::Range;

use ndarray::{ArrayView2, s};

use super::similarity::{MAX_GROWTH, MAX_ROTATION, REACH, Similarity};
use crate::crop;
use crate::tile::Window;

/// Pixels around a patch that the interpolation of its masks needs where all of them move by at most [`REACH`].
pub(super) const MARGIN: usize = 16 + REACH + 1;
/// Pixels of this margin that a small rotation may use: the spline's filter has nearly vanished there.
const SPARE: f64 = 2.0;
/// Shortest side in pixels of a patch.
pub(super) const SHORTEST_SIDE: usize = 32;
/// Largest distance in pixels from the first patch to the end of its neighbours. A rotation that these have found predicts
/// their displacements [`FARTHER`] times as far away within a fraction of a pixel.
const FIRST_REACH: usize = 128;
/// Ratio of the distances of patches from step to step.
const FARTHER: usize = 5;

/// The places of the patches.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Rows and columns of the picture.
    pub(super) sensor: [usize; 2],
    pub(super) margin: usize,
    /// The patch with the most structure.
    pub(super) first: Place,
    /// Other patches, each list farther away than the one before.
    pub(super) others: Vec<Vec<Place>>,
}

/// Rows and columns of a patch.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Place {
    pub(super) rows: Range<usize>,
    pub(super) columns: Range<usize>,
}

impl Place {
    /// The patch with a margin.
    pub(super) fn window(&self, margin: usize) -> Window {
        let around = |range: &Range<usize>| range.start - margin..range.end + margin;
        Window { rows: around(&self.rows), columns: around(&self.columns), step: 1 }
    }
}

/// The largest displacement in pixels by a rotation and a growth that are searched, at a distance from the centre.
fn largest(distance: f64) -> f64 {
    distance * MAX_ROTATION.to_radians().hypot(MAX_GROWTH)
}

impl Plan {
    /// Selects patches in a measurement `y` \[H,W\] behind masks with the sum `light` \[H,W\]: each is a crop as
    /// [`crop::choose`] selects it. `None` if the picture is too small.
    pub fn choose(light: ArrayView2<'_, f32>, y: ArrayView2<'_, f32>) -> Option<Self> {
        let (height, width) = y.dim();
        let turned = largest((height as f64).hypot(width as f64) / 2.0);
        let margin = MARGIN + (turned - SPARE).max(0.0).ceil() as usize;
        if height.min(width) < SHORTEST_SIDE + 2 * margin {
            return None;
        }
        let inner = [margin..height - margin, margin..width - margin];
        let crop = |rows: &Range<usize>, columns: &Range<usize>| {
            let region = s![rows.clone(), columns.clone()];
            let (inside, across) = crop::choose(light.slice(region), y.slice(region));
            Place {
                rows: rows.start + inside.start..rows.start + inside.end,
                columns: columns.start + across.start..columns.start + across.end,
            }
        };
        let first = crop(&inner[0], &inner[1]);
        let sides = [(&first.rows, &inner[0]), (&first.columns, &inner[1])];
        let rooms = sides.map(|(patch, inner)| room(patch, inner).len());
        let mut others = Vec::new();
        let mut reach = FIRST_REACH;
        loop {
            let is_last = rooms.iter().all(|room| *room <= 2 * reach);
            let [rows, columns] = sides.map(|(patch, inner)| {
                far(room(patch, inner), patch, if is_last { usize::MAX } else { reach })
            });
            let mut places = Vec::new();
            places.extend(rows.as_ref().map(|rows| crop(rows, &first.columns)));
            places.extend(columns.as_ref().map(|columns| crop(&first.rows, columns)));
            places.extend(rows.zip(columns).map(|(rows, columns)| crop(&rows, &columns)));
            others.push(places);
            if is_last {
                break;
            }
            reach *= FARTHER;
        }
        Some(Self { sensor: [height, width], margin, first, others })
    }

    /// Largest displacement in whole pixels of the first patch.
    pub(super) fn reach(&self) -> usize {
        let centre = |range: &Range<usize>| (range.start + range.end) as f64 / 2.0;
        let [height, width] = self.sensor.map(|side| side as f64 / 2.0);
        let distance =
            (centre(&self.first.rows) - height).hypot(centre(&self.first.columns) - width);
        REACH + largest(distance).round() as usize
    }

    /// True if a motion is within the reach of the search.
    pub(super) fn includes(&self, motion: &Similarity) -> bool {
        // A true motion at the limit may be estimated a little beyond it.
        motion.shift.iter().all(|shift| shift.abs() <= REACH as f64 + 0.5)
            && motion.rotation.abs() <= 1.2 * MAX_ROTATION
            && (motion.scale - 1.0).abs() <= 1.2 * MAX_GROWTH
    }
}

/// The longer of the two ranges before and after a patch.
fn room(patch: &Range<usize>, inner: &Range<usize>) -> Range<usize> {
    let (before, after) = (inner.start..patch.start, patch.end..inner.end);
    if before.len() > after.len() { before } else { after }
}

/// The part of a range that is farthest from a patch, up to `reach` pixels away. `None` if it is too short.
fn far(room: Range<usize>, patch: &Range<usize>, reach: usize) -> Option<Range<usize>> {
    let length = room.len().min(reach);
    let part = length.min(crop::SIDE.max(length / 3));
    let range = if room.start < patch.start {
        room.end - length..room.end - length + part
    } else {
        room.start + length - part..room.start + length
    };
    (range.len() >= SHORTEST_SIDE).then_some(range)
}

#[cfg(test)]
mod tests {
    use super::{MARGIN, Plan};
    use ndarray::Array2;

    #[test]
    fn pieces_do_not_overlap_and_lie_within_the_picture() {
        let sizes = [(74, 80), (138, 138), (200, 150), (256, 256), (1600, 1700), (3200, 3200)];
        for ((height, width), (steps, count)) in
            sizes.into_iter().zip([(1, 0), (1, 0), (1, 1), (1, 3), (2, 6), (3, 9)])
        {
            let y = Array2::from_shape_fn((height, width), |(i, j)| {
                let [i, j] = [i as f32 - height as f32 / 2.0, j as f32 - width as f32 / 2.0];
                (1.0 - i.hypot(j) / 2300.0) * (i * j).cos()
            });
            let light = Array2::ones((height, width));
            let plan = Plan::choose(light.view(), y.view()).unwrap();
            assert_eq!(plan.others.len(), steps, "{plan:?}");
            let all: Vec<_> = plan.others.iter().flatten().chain([&plan.first]).collect();
            assert_eq!(all.len(), count + 1, "{plan:?}");
            for (index, one) in all.iter().enumerate() {
                let window = one.window(plan.margin);
                assert!(window.rows.end <= height && window.columns.end <= width, "{plan:?}");
                assert!(plan.margin >= MARGIN && one.rows.len() <= 96 && one.columns.len() >= 32);
                let is_separate = |other: &super::Place| {
                    one.rows.end <= other.rows.start
                        || other.rows.end <= one.rows.start
                        || one.columns.end <= other.columns.start
                        || other.columns.end <= one.columns.start
                };
                assert!(all[index + 1..].iter().all(|other| is_separate(other)), "{plan:?}");
            }
        }
        let small = Array2::ones((73, 200));
        assert_eq!(Plan::choose(small.view(), small.view()), None);
    }
}
