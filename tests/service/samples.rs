//! Small generated scenes and files, so that a test shows all of its input.

/// A square that moves over a ramp, coded by random masks.
#[derive(Debug, Clone, Copy)]
pub struct Scene {
    pub frames: usize,
    pub height: usize,
    pub width: usize,
    pub snapshots: usize,
}

impl Scene {
    pub const SMALL: Self = Self { frames: 4, height: 48, width: 64, snapshots: 2 };

    /// A mask's pixel, open or closed.
    pub fn mask(self, frame: usize, row: usize, column: usize) -> f32 {
        // A hash of the position opens half of the pixels.
        let mut state = (frame * 7919 + row * 104_729 + column * 1_299_709 + 1) as u64;
        state = (state ^ (state >> 15)).wrapping_mul(0x2c1b_3c6d_9e37_79b9);
        state = (state ^ (state >> 29)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        if state >> 63 == 1 { 1.0 } else { 0.0 }
    }

    /// A pixel of the scene in a snapshot's frame.
    pub fn pixel(self, snapshot: usize, frame: usize, row: usize, column: usize) -> f32 {
        let moved = 4 + 2 * (snapshot * self.frames + frame);
        let inside = (8..24).contains(&row) && (moved..moved + 16).contains(&column);
        let ramp = column as f32 / self.width as f32 * 0.5;
        if inside { 0.9 } else { ramp }
    }

    /// The masks as .npy, float32 [B, H, W].
    pub fn masks(self) -> Vec<u8> {
        let values = (0..self.frames)
            .flat_map(|k| (0..self.height).map(move |i| (k, i)))
            .flat_map(|(k, i)| (0..self.width).map(move |j| self.mask(k, i, j)));
        npy(&[self.frames, self.height, self.width], values)
    }

    /// The snapshots as .npy, float32 [S, H, W].
    pub fn snapshots(self) -> Vec<u8> {
        self.with_a_cut(self.snapshots)
    }

    /// The snapshots; from snapshot `before` on, they show the negative of the scene.
    pub fn with_a_cut(self, before: usize) -> Vec<u8> {
        let pixel = move |s, k, i, j| {
            let value = self.pixel(s, k, i, j);
            if s < before { value } else { 1.0 - value }
        };
        let value =
            move |s, i, j| (0..self.frames).map(|k| self.mask(k, i, j) * pixel(s, k, i, j)).sum();
        let values = (0..self.snapshots)
            .flat_map(|s| (0..self.height).map(move |i| (s, i)))
            .flat_map(|(s, i)| (0..self.width).map(move |j| value(s, i, j)));
        npy(&[self.snapshots, self.height, self.width], values)
    }
}

/// A .npy file of float32.
pub fn npy(shape: &[usize], values: impl Iterator<Item = f32>) -> Vec<u8> {
    let mut file = npy_header("<f4", shape);
    file.extend(values.flat_map(f32::to_le_bytes));
    file
}

/// The header of a .npy file.
pub fn npy_header(kind: &str, shape: &[usize]) -> Vec<u8> {
    let sides: String = shape.iter().map(|side| format!("{side},")).collect();
    let mut header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({sides}), }}");
    while (header.len() + 11) % 64 != 0 {
        header.push(' ');
    }
    header.push('\n');
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend((header.len() as u16).to_le_bytes());
    file.extend(header.bytes());
    file
}

/// A .npy file with one value everywhere.
pub fn constant(shape: &[usize], value: f32) -> Vec<u8> {
    npy(shape, std::iter::repeat_n(value, shape.iter().product()))
}

/// A small little-endian TIFF with one uint8 page, whose pixels are at the end.
pub fn tiff(height: u32, width: u32) -> Vec<u8> {
    let entries: [(u16, u16, u32); 8] = [
        (256, 4, width),
        (257, 4, height),
        (258, 3, 8),
        (259, 3, 1),
        (262, 3, 1),
        (273, 4, 8 + 2 + 8 * 12 + 4),
        (278, 4, height),
        (279, 4, height * width),
    ];
    let mut file = b"II\x2a\0\x08\0\0\0".to_vec();
    file.extend((entries.len() as u16).to_le_bytes());
    for (tag, kind, value) in entries {
        file.extend(tag.to_le_bytes());
        file.extend(kind.to_le_bytes());
        file.extend(1u32.to_le_bytes());
        file.extend(value.to_le_bytes());
    }
    file.extend(0u32.to_le_bytes());
    file.extend((0..height * width).map(|at| (at % 251) as u8));
    file
}
