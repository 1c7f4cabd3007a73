//! Pixels of a snapshot that carry no information on the scene: saturated ones, and outliers.

use std::ops::Range;

use ndarray::{Array2, ArrayView1, ArrayView2};

use super::{Finding, FindingCode};

/// Smallest number of pixels at the largest value that counts as a pile-up.
const MIN_PILE_UP: usize = 8;
/// A pile-up has this many times the pixels of the other values near the largest one. Simulated snapshots of 2 to 16
/// frames have at most 0.6 times, clipped ones at least 10 times.
const PILE_UP_RATIO: f64 = 4.0;
/// Values above this share of the largest one are compared with it.
const NEAR_LARGEST: f32 = 0.9;
/// A white scene reaches the largest value where all masks are open. This share of the pixels may differ.
const MAX_DIFFERENT: f64 = 0.05;

/// Value from which on the pixels of a snapshot are saturated, if they are: `stated`, or the largest value if pixels pile
/// up at it. `values` \[H,W\] are as stored, NaN where nothing was measured; `light` \[H,W\] is the sum of the masks.
///
/// A sensor clips what is brighter than its largest value, whatever the type of the file and its full scale.
pub fn saturation(
    values: ArrayView2<'_, f32>,
    light: ArrayView2<'_, f32>,
    stated: Option<f32>,
) -> Option<f32> {
    if stated.is_some() {
        return stated;
    }
    let finite = values.iter().zip(&light).filter(|(value, _)| value.is_finite());
    let largest = finite.clone().map(|(value, _)| *value).fold(f32::NEG_INFINITY, f32::max);
    let (brightest, smallest) =
        finite.clone().fold((0f32, f32::INFINITY), |(light, least), (value, l)| {
            (light.max(*l), least.min(*value))
        });
    if largest <= 0.0 || smallest == largest {
        return None;
    }
    let (mut piled_up, mut different, mut near) = (0usize, 0usize, Vec::new());
    for (&value, &light) in finite {
        if value == largest {
            piled_up += 1;
            different += usize::from(light < 0.999 * brightest);
        } else if value > NEAR_LARGEST * largest {
            near.push(value);
        }
    }
    near.sort_unstable_by(f32::total_cmp);
    let values = near.chunk_by(|one, next| one == next).count().max(1);
    #[allow(clippy::cast_precision_loss)] // counts of pixels
    let is_pile_up = piled_up >= MIN_PILE_UP
        && piled_up as f64 >= PILE_UP_RATIO * near.len() as f64 / values as f64
        && different as f64 > MAX_DIFFERENT * piled_up as f64;
    is_pile_up.then_some(largest)
}

/// Distance of the farthest neighbours of a pixel along each axis.
const REACH: usize = 2;
/// Number of neighbours that may be outliers themselves.
const FEW: usize = 2;
/// A pixel is too bright at this many times the brightest neighbours.
const TOO_BRIGHT: f32 = 2.0;
/// A pixel is too dark at this share of the darkest neighbours.
const TOO_DARK: f32 = 0.05;
/// Smallest deviations of outliers, as shares of the 99th percentile of the snapshot.
const MIN_EXCESS: f32 = 0.1;
const MIN_DEFICIT: f32 = 0.25;
/// Masks must pass this share of the mean light to compare the brightness of neighbours, or of that of the pixel in a dim area,
/// and this share to call a pixel dark.
const ENOUGH_LIGHT: f32 = 0.25;
const MUCH_LIGHT: f32 = 0.75;

/// Pixels (row, column) that are far brighter or darker than their neighbours and than their masks allow: hot and dead
/// ones. `y` \[H,W\] is a snapshot without dark, NaN where nothing was measured; `light` \[H,W\] is the sum of the masks.
/// Neighbours are `step` pixels apart: 2 behind a mosaic, where they have one colour.
///
/// The brightness of the scene at a pixel is at least `y / light`. A hot pixel exceeds both the values and `light` times the
/// brightness of nearly all of its 24 neighbours twice. A dead one has a twentieth of that brightness. Dead rows and columns
/// are found as wholes.
pub fn outliers(
    y: ArrayView2<'_, f32>,
    light: ArrayView2<'_, f32>,
    step: usize,
) -> Vec<(usize, usize)> {
    let (height, width) = y.dim();
    let mut sorted: Vec<f32> = y.iter().copied().filter(|value| value.is_finite()).collect();
    if sorted.is_empty() {
        return Vec::new();
    }
    let index = (sorted.len() - 1) * 99 / 100;
    let (_, &mut bright, _) = sorted.select_nth_unstable_by(index, f32::total_cmp);
    // Areas without masks, or where all masks are dark, do not lower the mean.
    let lit = || light.iter().copied().filter(|light| *light > 0.0);
    let mean_light = lit().sum::<f32>() / lit().count().max(1) as f32;
    if bright <= 0.0 || mean_light <= 0.0 {
        return Vec::new();
    }
    let (excess, deficit) = (MIN_EXCESS * bright, MIN_DEFICIT * bright);
    let neighbours = |at: usize, length: usize| {
        let first = at - step * (at / step).min(REACH);
        (first..length.min(at + step * REACH + 1)).step_by(step)
    };
    let is_outlier = |&((row, column), &value): &((usize, usize), &f32)| {
        let own = light[[row, column]];
        // Most pixels need no look at their neighbours.
        let may_be_dark =
            own > MUCH_LIGHT * mean_light && value < TOO_DARK * own / mean_light * bright;
        if !value.is_finite() || !(value > excess || may_be_dark) {
            return false;
        }
        let compare = |enough: f32| {
            let mut values = [f32::NEG_INFINITY; FEW + 1];
            let mut ratios = [f32::NEG_INFINITY; FEW + 1];
            let mut darkest = [f32::INFINITY; FEW];
            for row_near in neighbours(row, height) {
                for column_near in neighbours(column, width) {
                    let near = y[[row_near, column_near]];
                    if (row_near, column_near) == (row, column) || !near.is_finite() {
                        continue;
                    }
                    insert(&mut values, near, |new, old| new > old);
                    let light = light[[row_near, column_near]];
                    if light > enough {
                        insert(&mut ratios, near / light, |new, old| new > old);
                        insert(&mut darkest, near / light, |new, old| new < old);
                    }
                }
            }
            [values[FEW], ratios[FEW], darkest[FEW - 1]]
        };
        let mut compared = compare(ENOUGH_LIGHT * mean_light);
        if !compared[1].is_finite() {
            // The area is dim.
            compared = compare(ENOUGH_LIGHT * own);
        }
        let [brightest, ratio, darkest] = compared;
        if !compared.iter().all(|value| value.is_finite()) {
            return false;
        }
        let is_hot = value > TOO_BRIGHT * brightest.max(0.0) + excess
            && value > TOO_BRIGHT * own * ratio.max(0.0) + excess;
        let expected = own * darkest;
        let is_dead =
            own > MUCH_LIGHT * mean_light && expected > deficit && value < TOO_DARK * expected;
        is_hot || is_dead
    };
    let mut places: Vec<_> = y.indexed_iter().filter(is_outlier).map(|(place, _)| place).collect();
    let levels = (mean_light, deficit);
    places.extend(dead_lines(y, light, step, levels));
    let columns = dead_lines(y.t(), light.t(), step, levels).into_iter();
    places.extend(columns.map(|(column, row)| (row, column)));
    places.sort_unstable();
    places.dedup();
    places
}

/// A line of pixels is dead if this share of at least this many pixels is.
const DEAD_LINE: f64 = 0.8;
const MIN_LINE: usize = 16;
/// A line is not dead if this share of its pixels has light. More dead lines than this share are lines of the scene.
const MAX_ALIVE: f64 = 0.05;

/// Pixels of dead rows and columns of a sensor. Each is compared with the pixels on both sides of its line, because those
/// along it are dead too. The arguments are those of [`outliers`].
///
/// At an edge of the scene one side is dark, so both sides must be bright.
#[allow(clippy::cast_precision_loss)] // counts of pixels
fn dead_lines(
    y: ArrayView2<'_, f32>,
    light: ArrayView2<'_, f32>,
    step: usize,
    (mean_light, deficit): (f32, f32),
) -> Vec<(usize, usize)> {
    let (height, width) = y.dim();
    let is_dead = |row: usize| {
        let (mut dead, mut compared, mut alive) = (0usize, 0usize, 0usize);
        let sides = [row.checked_sub(step), Some(row + step).filter(|row| *row < height)];
        for column in 0..width {
            let (value, own) = (y[[row, column]], light[[row, column]]);
            if value.is_nan() {
                continue;
            }
            alive += usize::from(value > deficit);
            let sides = sides.into_iter().flatten();
            let brightness = sides.map(|side| (y[[side, column]], light[[side, column]]));
            let darker = brightness.fold(f32::INFINITY, |darker, (near, light)| {
                let is_known = light > ENOUGH_LIGHT * mean_light && !near.is_nan();
                darker.min(if is_known { near / light } else { 0.0 })
            });
            let expected = own * darker;
            if own > MUCH_LIGHT * mean_light && expected > deficit && expected.is_finite() {
                compared += 1;
                dead += usize::from(value < TOO_DARK * expected);
            }
        }
        let share = dead as f64 / compared.max(1) as f64;
        compared >= MIN_LINE && share > DEAD_LINE && alive as f64 <= MAX_ALIVE * width as f64
    };
    let rows: Vec<usize> = (0..height).filter(|row| is_dead(*row)).collect();
    if rows.len() as f64 > MAX_ALIVE * height as f64 {
        return Vec::new();
    }
    rows.into_iter().flat_map(|row| (0..width).map(move |column| (row, column))).collect()
}

/// A run of equal values is frozen if the light of the masks changes this often within it, each time by this share. Behind
/// masks of random pixels equal values of a scene end after a few changes.
const FROZEN_CHANGES: usize = 8;
const LIGHT_CHANGE: f32 = 0.02;

/// Pixels of frozen parts of the sensor: runs along rows or columns with one value, well above the black level, although the
/// masks let different light through. `values` \[H,W\] are as stored, NaN where nothing was measured; `light` \[H,W\] is the
/// sum of the masks.
///
/// Integers that are coarser than the changes of the light may be equal by chance, so they are not compared.
fn frozen(values: ArrayView2<'_, f32>, light: ArrayView2<'_, f32>) -> Vec<(usize, usize)> {
    let finite = || values.iter().copied().filter(|value| value.is_finite());
    let (low, high) = (black_level(finite()), limits(finite()).1);
    let rows = runs_of_rows(values, light).into_iter().map(|run| (run, false));
    let columns = runs_of_columns(values, light).into_iter().map(|run| (run, true));
    let mut all: Vec<_> = rows.chain(columns).collect();
    all.retain(|(run, _)| run.value > low + MIN_EXCESS * (high - low));
    if all.is_empty() {
        return Vec::new();
    }
    let mut steps: Vec<f32> = finite().collect();
    steps.sort_unstable_by(f32::total_cmp);
    steps.dedup();
    // Distance to the next value that the snapshot has.
    let step = |value: f32| {
        let at = steps.partition_point(|other| *other < value);
        let next = [at.checked_sub(1), Some(at + 1)].into_iter().flatten();
        let next = next.filter_map(|at| steps.get(at)).map(|other| (other - value).abs());
        next.fold(f32::INFINITY, f32::min)
    };
    all.retain(|(run, _)| (run.value - low) * run.contrast > 2.0 * step(run.value));
    let places = all.into_iter().flat_map(|(run, is_column)| {
        run.along.map(move |at| if is_column { (at, run.line) } else { (run.line, at) })
    });
    let mut places: Vec<_> = places.collect();
    places.sort_unstable();
    places.dedup();
    places
}

/// Share of the values, without zeros, that are below the black level.
const BELOW_BLACK: f64 = 0.05;

/// The level of the darkest parts of a snapshot, whatever a few dead pixels and a border of zeros hold.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)] // counts of pixels
fn black_level(values: impl Iterator<Item = f32>) -> f32 {
    let mut values: Vec<f32> = values.filter(|value| *value != 0.0).collect();
    if values.is_empty() {
        return 0.0;
    }
    let index = (values.len() as f64 * BELOW_BLACK) as usize;
    *values.select_nth_unstable_by(index, f32::total_cmp).1
}

/// Equal values along a line.
struct Run {
    value: f32,
    line: usize,
    along: Range<usize>,
    /// Standard deviation of the light in the run, relative to its mean.
    contrast: f32,
}

impl Run {
    /// The run along a line of values and light; `None` if it is short, or the light changes too seldom in it.
    fn new(
        (values, light): (ArrayView1<'_, f32>, ArrayView1<'_, f32>),
        (line, along): (usize, Range<usize>),
    ) -> Option<Self> {
        let value = values[along.start];
        if along.len() <= FROZEN_CHANGES || !value.is_finite() {
            return None;
        }
        let light = light.slice(ndarray::s![along.clone()]);
        let mean = light.mean().unwrap_or(0.0);
        let changes = light.windows(2).into_iter();
        let changes = changes.filter(|pair| (pair[1] - pair[0]).abs() > LIGHT_CHANGE * mean);
        let is_frozen = mean > 0.0 && changes.count() >= FROZEN_CHANGES;
        is_frozen.then(|| Self { value, line, along, contrast: light.std(0.0) / mean })
    }
}

/// Runs along the rows.
fn runs_of_rows(values: ArrayView2<'_, f32>, light: ArrayView2<'_, f32>) -> Vec<Run> {
    let mut runs = Vec::new();
    for (line, lines) in values.outer_iter().zip(light.outer_iter()).enumerate() {
        let (mut start, width) = (0, lines.0.len());
        for at in 1..=width {
            if at == width || lines.0[at] != lines.0[at - 1] {
                runs.extend(Run::new(lines, (line, start..at)));
                start = at;
            }
        }
    }
    runs
}

/// Runs along the columns, which are read row by row.
fn runs_of_columns(values: ArrayView2<'_, f32>, light: ArrayView2<'_, f32>) -> Vec<Run> {
    let (height, width) = values.dim();
    let (mut runs, mut starts) = (Vec::new(), vec![0; width]);
    for at in 1..=height {
        for (line, start) in starts.iter_mut().enumerate() {
            if at == height || values[[at, line]] != values[[at - 1, line]] {
                runs.extend(Run::new(
                    (values.column(line), light.column(line)),
                    (line, *start..at),
                ));
                *start = at;
            }
        }
    }
    runs
}

/// Inserts a value into a list in order and drops the last one.
fn insert(list: &mut [f32], value: f32, before: impl Fn(f32, f32) -> bool) {
    let Some(place) = list.iter().position(|old| before(value, *old)) else { return };
    list[place..].rotate_right(1);
    list[place] = value;
}

/// A snapshot in which saturated pixels and outliers are NaN, and their numbers.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Defects {
    /// Number of pixels that were NaN, or bad by the calibration.
    pub missing: usize,
    /// Number of outliers.
    pub outliers: usize,
    /// Number of pixels in frozen parts of the sensor.
    pub frozen: usize,
    /// Number of pixels in areas without a measured pixel.
    pub unmeasured: usize,
    /// Number of saturated pixels.
    pub saturated: usize,
    /// Value from which on pixels are saturated.
    pub level: Option<f32>,
    /// True if the snapshot has exactly two values, as the masks of a modulator do.
    pub is_binary: bool,
}

/// The smallest and the largest of the values.
fn limits(values: impl Iterator<Item = f32>) -> (f32, f32) {
    values.fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), value| {
        (low.min(value), high.max(value))
    })
}

/// True if there are exactly two values apart from NaN.
fn is_binary(values: &Array2<f32>) -> bool {
    let finite = || values.iter().copied().filter(|value| value.is_finite());
    let (low, high) = limits(finite());
    low < high && finite().all(|value| value == low || value == high)
}

impl Defects {
    /// Marks the defects of a snapshot \[H,W\], as stored, with NaN. `dark` is subtracted where outliers are looked for.
    /// Where `light` \[H,W\], the sum of the masks, is NaN, the calibration has no masks.
    pub fn mark(
        values: &mut Array2<f32>,
        dark: Option<&Array2<f32>>,
        light: ArrayView2<'_, f32>,
        (step, stated): (usize, Option<f32>),
    ) -> Self {
        let mut found = Self::default();
        ndarray::azip!((value in &mut *values, &light in &light) {
            if light.is_nan() {
                *value = f32::NAN;
            }
        });
        found.missing = values.iter().filter(|value| value.is_nan()).count();
        found.is_binary = is_binary(values);
        if found.is_binary {
            // No photograph has two values, so none of them is a limit of the sensor or an outlier.
            return found;
        }
        let y = dark.map_or_else(|| values.clone(), |dark| &*values - dark);
        for place in outliers(y.view(), light, step) {
            values[place] = f32::NAN;
            found.outliers += 1;
        }
        found.mark_saturated(values, light, stated);
        for place in frozen(values.view(), light) {
            values[place] = f32::NAN;
            found.frozen += 1;
        }
        let areas = values.exact_chunks((AREA, AREA)).into_iter();
        let unmeasured = areas.filter(|area| area.iter().all(|value| value.is_nan()));
        found.unmeasured = AREA * AREA * unmeasured.count();
        found
    }

    fn mark_saturated(
        &mut self,
        values: &mut Array2<f32>,
        light: ArrayView2<'_, f32>,
        stated: Option<f32>,
    ) {
        self.level = saturation(values.view(), light, stated);
        if let Some(level) = self.level {
            self.saturated = values.iter().filter(|value| **value >= level).count();
            // Without nearly all pixels there is nothing to reconstruct from.
            if self.saturated * 10 <= values.len() * 9 {
                values.mapv_inplace(|value| if value >= level { f32::NAN } else { value });
            }
        }
    }
}

/// Share of saturated pixels, and of outliers, from which there is a finding, and from which frames are wrong.
const REPORTED_SHARE: f64 = 0.001;
const GRAVE_SHARE: f64 = 0.2;
/// Share of pixels marked as not measured, outside of areas without a measured pixel, above which frames are wrong. The
/// expected PSNR was compared with the true one up to this share.
const MAX_MISSING: f64 = 0.5;
/// Side of the areas that are searched for measured pixels.
const AREA: usize = 16;

/// Smallest share of a picture without an open mask that is reported.
const MIN_CLOSED: f64 = 0.002;

/// A pixel is closed if its largest mask value is at most this share of the mean over all pixels. The solver would amplify its
/// noise twenty times and more.
const MIN_OPEN: f32 = 0.05;

/// True for pixels without an open mask. `largest` \[H,W\] is the largest value of the masks at each pixel, NaN where they
/// are not known.
pub fn closed_pixels(largest: ArrayView2<'_, f32>) -> Array2<bool> {
    let lit = || largest.iter().copied().filter(|largest| *largest > 0.0);
    #[allow(clippy::cast_precision_loss)] // counts of pixels
    let mean = lit().sum::<f32>() / lit().count().max(1) as f32;
    largest.mapv(|largest| largest <= MIN_OPEN * mean)
}

/// Reports areas of \[H,W\] in which all pixels are closed.
#[allow(clippy::cast_precision_loss)] // counts of pixels
pub fn judge_closed(is_closed: ArrayView2<'_, bool>) -> Option<Finding> {
    let areas = is_closed.exact_chunks((AREA, AREA)).into_iter();
    let closed = areas.filter(|area| area.iter().all(|closed| *closed)).count();
    let share = (AREA * AREA * closed) as f64 / is_closed.len().max(1) as f64;
    (share > MIN_CLOSED).then(|| {
        let detail = format!(
            "at least {:.1} % of the picture lies in areas where no mask is open: there is no picture there, and the expected \
             PSNR does not count these areas",
            100.0 * share
        );
        Finding::new(FindingCode::DeadPixels, detail)
    })
}

/// Reports the defects of a snapshot of `pixels` pixels.
#[allow(clippy::cast_precision_loss)] // counts of pixels
pub fn judge_defects(defects: &Defects, pixels: usize) -> Vec<Finding> {
    const LEFT_OUT: &str = "They are left out of the reconstruction";
    let share = |count: usize| count as f64 / pixels.max(1) as f64;
    let mut findings = Vec::new();
    let Defects { missing, outliers, frozen, unmeasured, saturated, level, is_binary } = *defects;
    if is_binary {
        let detail = "the snapshot has only two values, as masks have";
        findings.push(Finding::new(FindingCode::BinaryMeasurement, detail));
    }
    if let (Some(level), true) = (level, share(saturated) > REPORTED_SHARE) {
        let detail = format!(
            "{:.2} % of the pixels are at {level} or above, the limit of the sensor: they were saturated. {LEFT_OUT}",
            100.0 * share(saturated)
        );
        let finding = Finding::new(FindingCode::Saturated, detail);
        findings.push(finding.escalate_if(share(saturated) > GRAVE_SHARE));
    }
    if missing + outliers + frozen > 0 {
        let mut parts = Vec::new();
        if outliers > 0 {
            parts.push(format!(
                "{outliers} pixels are far brighter or darker than their neighbours and their masks allow"
            ));
        }
        if frozen > 0 {
            parts.push(format!(
                "{frozen} pixels have the value of their neighbours although the masks differ: that part of the sensor \
                 or of its transfer was frozen"
            ));
        }
        if missing > 0 {
            parts.push(format!("{missing} pixels are marked as not measured"));
        }
        let mut detail = format!("{}. {LEFT_OUT}", parts.join(", and "));
        if unmeasured > 0 {
            let percent = 100.0 * share(unmeasured);
            detail += &format!(
                ". At least {percent:.1} % of the picture lies in areas without a measured pixel, where the frames are a \
                 guess"
            );
        }
        // The user knows of the pixels that are marked. Frames follow the measurement where it is measured.
        let rest = pixels.saturating_sub(unmeasured).max(1) as f64;
        let scattered = missing.saturating_sub(unmeasured) as f64 / rest;
        let grave = share(outliers + frozen) > GRAVE_SHARE || scattered > MAX_MISSING;
        findings.push(Finding::new(FindingCode::BadPixels, detail).escalate_if(grave));
    }
    findings
}

#[cfg(test)]
mod tests {
    use super::{
        AREA, Defects, MIN_PILE_UP, closed_pixels, judge_closed, limits, outliers, saturation,
    };
    use crate::{iid_masks, measure, noisy, random_squares};
    use ndarray::{Array2, Array3, Axis, s};

    /// A bright disc that moves over dark texture.
    fn scene(frames: usize) -> Array3<f32> {
        Array3::from_shape_fn((frames, 96, 96), |(k, i, j)| {
            let at = (i as f32 - 40.0).hypot(j as f32 - 30.0 - 3.0 * k as f32);
            if at < 9.0 { 0.9 } else { 0.1 + 0.1 * (i as f32 * 0.7).sin() * (j as f32 * 0.4).cos() }
        })
    }

    fn all_masks(frames: usize) -> [Array3<f32>; 2] {
        [iid_masks(frames, 96, 96, 3).unwrap(), random_squares(frames, 96, 96, 3).unwrap().0]
    }

    #[test]
    fn hot_and_dead_pixels_are_found_and_scenes_have_none() {
        for (frames, masks) in [4, 8, 16].into_iter().flat_map(|b| all_masks(b).map(|m| (b, m))) {
            let light = masks.sum_axis(Axis(0));
            let clean = measure(masks.view(), scene(frames).view()).unwrap();
            for noise in [0.0, 0.02] {
                let y = noisy(clean.clone(), noise, 1).unwrap();
                assert_eq!(outliers(y.view(), light.view(), 1), [], "{frames} {noise}");
            }
            let mut y = clean.clone();
            let places = [(3, 3), (40, 50), (41, 50), (90, 95)];
            let hot = 3.0 * clean.iter().copied().fold(0.0, f32::max);
            places.iter().for_each(|place| y[*place] = hot);
            let found = outliers(y.view(), light.view(), 1);
            assert_eq!(found, places, "{frames}");
        }
    }

    #[test]
    fn dead_rows_and_columns_are_found_as_wholes() {
        for (frames, masks) in [4, 8, 16].into_iter().flat_map(|b| all_masks(b).map(|m| (b, m))) {
            let light = masks.sum_axis(Axis(0));
            let mut y = measure(masks.view(), (scene(frames) * 0.5 + 0.4).view()).unwrap();
            y.column_mut(33).fill(0.0);
            y.row_mut(0).fill(-0.02);
            let found = outliers(y.view(), light.view(), 1);
            let is_dead = |(row, column): (usize, usize)| row == 0 || column == 33;
            assert!(found.iter().copied().all(is_dead), "{frames}");
            assert_eq!(found.len(), 96 + 95, "{frames}");
        }
    }

    #[test]
    fn a_pile_up_is_saturation_in_any_unit() {
        for (frames, masks) in [4, 8, 16].into_iter().flat_map(|b| all_masks(b).map(|m| (b, m))) {
            let light = masks.sum_axis(Axis(0));
            let y = measure(masks.view(), scene(frames).view()).unwrap();
            let brightest = y.iter().copied().fold(0.0, f32::max);
            for unit in [1.0, 4095.0] {
                let stored = |y: &Array2<f32>| match unit {
                    1.0 => y.clone(),
                    _ => (y / brightest * unit).mapv(f32::round),
                };
                assert_eq!(saturation(stored(&y).view(), light.view(), None), None, "{frames}");
                for clip in [0.5, 0.8] {
                    let level = clip * brightest;
                    let mut clipped = stored(&y.mapv(|y| y.min(level)));
                    let expected = clipped.iter().copied().fold(0.0, f32::max);
                    let count = clipped.iter().filter(|value| **value == expected).count();
                    if count < MIN_PILE_UP {
                        continue;
                    }
                    let found = Defects::mark(&mut clipped, None, light.view(), (1, None));
                    assert_eq!(
                        (found.level, found.saturated),
                        (Some(expected), count),
                        "{found:?}"
                    );
                    assert_eq!(clipped.iter().filter(|value| value.is_nan()).count(), count);
                }
            }
        }
    }

    /// Bars and boxes on black have rows and columns without light beside bright ones.
    #[test]
    fn edges_of_a_scene_are_no_dead_lines() {
        let bars = |period: usize| {
            move |_: usize, i: usize, _: usize| f32::from(u8::from((i / period).is_multiple_of(2)))
        };
        let boxed = |k: usize, i: usize, j: usize| {
            let at = 20 + 2 * k;
            f32::from(u8::from((at..at + 30).contains(&i) && (30..70).contains(&j)))
        };
        for masks in all_masks(8) {
            let light = masks.sum_axis(Axis(0));
            let check = |name: &str, scene: &dyn Fn(usize, usize, usize) -> f32| {
                let scene = Array3::from_shape_fn((8, 96, 96), |(k, i, j)| scene(k, i, j));
                let y = measure(masks.view(), scene.view()).unwrap();
                assert_eq!(outliers(y.view(), light.view(), 1), [], "{name}");
            };
            check("box", &boxed);
            for period in [1, 2, 4, 8] {
                check(&format!("bars of {period}"), &bars(period));
            }
        }
    }

    #[test]
    fn a_black_background_is_not_frozen_beside_zeros() {
        let masks = iid_masks(8, 96, 96, 3).unwrap();
        let light = masks.sum_axis(Axis(0));
        let mut object = scene(8) - 0.2;
        object.mapv_inplace(|x| x.max(0.0));
        let y = measure(masks.view(), object.view()).unwrap();
        let high = y.iter().copied().fold(0.0, f32::max);
        let mut y = y.mapv(|y| 16.0 + (60.0 * y / high).round());
        y.slice_mut(s![..4, ..]).fill(0.0);
        y[[50, 90]] = 0.0;
        let found = Defects::mark(&mut y, None, light.view(), (1, None));
        assert_eq!(found.frozen, 0);
    }

    #[test]
    fn hot_pixels_in_dim_corners_are_found() {
        let at = |i: usize, j: usize| (i as f32 - 48.0).hypot(j as f32 - 48.0) / 36.0;
        let mut masks = iid_masks(8, 96, 96, 3).unwrap();
        masks.indexed_iter_mut().for_each(|((_, i, j), mask)| *mask *= (-at(i, j).powi(2)).exp());
        let light = masks.sum_axis(Axis(0));
        let mut y = noisy(measure(masks.view(), scene(8).view()).unwrap(), 0.01, 1).unwrap();
        assert_eq!(outliers(y.view(), light.view(), 1), []);
        let places = [(5, 7), (88, 90)];
        let hot = 1.2 * y.iter().copied().fold(0.0, f32::max);
        places.iter().for_each(|place| y[*place] = hot);
        assert_eq!(outliers(y.view(), light.view(), 1), places);
    }

    #[test]
    fn areas_without_an_open_mask_are_reported() {
        let mut largest = Array2::from_elem((96, 96), 0.5);
        largest[[2, 2]] = f32::NAN;
        let found = |largest: &Array2<f32>| judge_closed(closed_pixels(largest.view()).view());
        assert_eq!(found(&largest), None);
        // Closed pixels may leak, and weak masks are open.
        for (value, is_closed) in [(0.0, true), (0.02, true), (0.04, false), (f32::NAN, false)] {
            largest.slice_mut(s![16..48, 32..64]).fill(value);
            let found = found(&largest);
            assert_eq!(found.is_some(), is_closed, "{value}");
            assert!(found.is_none_or(|found| found.detail.contains("11.1 %")));
        }
    }

    /// A patch or a line of one value in the middle of the range is no scene behind these masks.
    #[test]
    fn frozen_parts_of_the_sensor_are_left_out_and_scenes_have_none() {
        let patch = |y: &mut Array2<f32>, value| y.slice_mut(s![16..64, 32..80]).fill(value);
        for (frames, masks) in [4, 8, 16].into_iter().flat_map(|b| all_masks(b).map(|m| (b, m))) {
            let light = masks.sum_axis(Axis(0));
            let y = measure(masks.view(), scene(frames).view()).unwrap();
            let (low, high) = limits(y.iter().copied());
            let marked = |mut y: Array2<f32>| Defects::mark(&mut y, None, light.view(), (1, None));
            for steps in [f32::INFINITY, 4095.0, 255.0] {
                // A camera adds a constant to black parts, too.
                let camera = |y: &Array2<f32>| match steps {
                    f32::INFINITY => y.clone(),
                    _ => y.mapv(|y| (8.0 + y / high * steps).round()),
                };
                let black = |y: &Array2<f32>| {
                    let mut y = y.clone();
                    patch(&mut y, 0.0);
                    y
                };
                assert_eq!(marked(camera(&y)).frozen, 0, "{frames} {steps}");
                assert_eq!(marked(camera(&black(&y))).frozen, 0, "{frames} {steps}");
                let mut frozen = y.clone();
                patch(&mut frozen, (low + high) / 2.0);
                let found = marked(camera(&frozen));
                assert!((2304..2400).contains(&found.frozen), "{frames} {steps}: {found:?}");
                assert_eq!(found.unmeasured, 9 * AREA * AREA);
                let mut line = y.clone();
                line.column_mut(50).fill(0.6 * high);
                let found = marked(camera(&line));
                assert!(found.frozen + found.outliers >= 96, "{frames} {steps}: {found:?}");
            }
        }
    }

    /// A white scene reaches the same largest value at all pixels behind open masks.
    #[test]
    fn a_white_scene_is_not_saturated() {
        let masks = iid_masks(4, 96, 96, 3).unwrap();
        let y = measure(masks.view(), Array3::ones((4, 96, 96)).view()).unwrap();
        let light = masks.sum_axis(Axis(0));
        assert_eq!(saturation(y.view(), light.view(), None), None);
        assert_eq!(saturation(y.view(), light.view(), Some(3.0)), Some(3.0));
    }
}
