//! Explains why masks and a measurement have different sizes.

/// The most likely cause of masks and a measurement with these numbers of rows and columns, and what to do. `window` is the
/// advice for pictures that show different windows of the sensor.
pub fn size_remedy(masks: (usize, usize), measurement: (usize, usize), window: &str) -> String {
    let ((rows, columns), (height, width)) = (masks, measurement);
    let packed = |stored: usize, pixels: usize| 2 * stored == 3 * pixels;
    if (rows, columns) == (width, height) {
        return format!(
            "most likely one of the two is turned by 90 degrees or transposed: state its `axes`, or turn it back. \
             Otherwise {window}"
        );
    }
    if height == rows && packed(width, columns) || width == columns && packed(height, rows) {
        return format!(
            "most likely the measurement has two 12-bit pixels in three bytes: state its `packing`. Otherwise {window}"
        );
    }
    if rows * width == columns * height {
        let factor = height as f64 / rows as f64;
        return format!(
            "most likely one of the two was binned or resized (by a factor of {factor:.3}), because both have the same \
             shape: record and send both with the same binning. Otherwise {window}"
        );
    }
    window.to_owned()
}

#[cfg(test)]
mod tests {
    use super::size_remedy;

    #[test]
    fn the_sizes_show_the_likely_cause() {
        let cause = |masks, measurement| size_remedy(masks, measurement, "crop one");
        assert!(cause((96, 128), (128, 96)).starts_with("most likely one of the two is turned"));
        assert!(cause((96, 128), (192, 256)).contains("binned or resized (by a factor of 2.000)"));
        assert!(cause((96, 128), (96, 192)).contains("`packing`"));
        assert_eq!(cause((96, 128), (90, 128)), "crop one");
    }
}
