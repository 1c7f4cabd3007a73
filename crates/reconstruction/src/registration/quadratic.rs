//! Quadratic functions of the motion of masks, fitted to errors.

/// Number of parameters of a motion: shifts along rows and columns, rotation and growth.
pub const COUNT: usize = 4;

/// `c + g.p + p.H p / 2`.
#[derive(Clone, Copy, Default)]
pub struct Quadratic {
    pub gradient: [f64; COUNT],
    pub curvature: [[f64; COUNT]; COUNT],
}

impl Quadratic {
    /// The least-squares fit to values in row order on a grid of 3x3 displacements from -1 to 1 around `centre`. `motion` is
    /// the derivative of the displacement along rows and columns by each parameter.
    pub fn fit(value: impl Fn(usize) -> f64, motion: [[f64; COUNT]; 2], centre: [f64; 2]) -> Self {
        let sum = |weight: &dyn Fn(f64, f64) -> f64| {
            let place = |place: usize| ((place / 3) as f64 - 1.0, (place % 3) as f64 - 1.0);
            (0..9).map(|at| weight(place(at).0, place(at).1) * value(at)).sum::<f64>()
        };
        let slope = [sum(&|row, _| row) / 6.0, sum(&|_, column| column) / 6.0];
        let both = sum(&|row, column| row * column) / 4.0;
        let bend = [
            [sum(&|row, _| row * row - 2.0 / 3.0), both],
            [both, sum(&|_, column| column * column - 2.0 / 3.0)],
        ];
        let slope =
            [0, 1].map(|axis| slope[axis] - bend[axis][0] * centre[0] - bend[axis][1] * centre[1]);
        let mut fitted = Self::default();
        for (one, gradient) in fitted.gradient.iter_mut().enumerate() {
            *gradient = slope[0] * motion[0][one] + slope[1] * motion[1][one];
            for (other, curvature) in fitted.curvature[one].iter_mut().enumerate() {
                let pairs = [(0, 0), (0, 1), (1, 0), (1, 1)];
                let term = |(a, b): (usize, usize)| motion[a][one] * bend[a][b] * motion[b][other];
                *curvature = pairs.map(term).iter().sum();
            }
        }
        fitted
    }

    pub fn add(&mut self, other: &Self) {
        for one in 0..COUNT {
            self.gradient[one] += other.gradient[one];
            for (sum, value) in self.curvature[one].iter_mut().zip(other.curvature[one]) {
                *sum += value;
            }
        }
    }

    /// The gradient at a point.
    pub fn gradient_at(&self, point: [f64; COUNT]) -> [f64; COUNT] {
        let change = product(&self.curvature, point);
        std::array::from_fn(|one| self.gradient[one] + change[one])
    }

    /// The inverse of a positive definite curvature. Parameters on which nothing depends have a variance of 0.
    pub fn inverse(&self) -> Option<[[f64; COUNT]; COUNT]> {
        let mut factor = [[0.0; COUNT]; COUNT];
        let is_free = |one: usize| self.curvature[one].iter().any(|value| *value != 0.0);
        for one in 0..COUNT {
            for other in 0..=one {
                let known = (0..other).map(|k| factor[one][k] * factor[other][k]).sum::<f64>();
                let rest = self.curvature[one][other] - known;
                factor[one][other] = match (one == other, is_free(one)) {
                    (true, false) => 1.0,
                    (true, true) if rest > 1e-9 * self.curvature[one][one] && rest > 0.0 => {
                        rest.sqrt()
                    }
                    (true, true) => return None,
                    (false, _) => rest / factor[other][other],
                };
            }
        }
        let column = |index: usize| {
            let mut at = [0.0; COUNT];
            at[index] = f64::from(u8::from(is_free(index)));
            for one in 0..COUNT {
                let known = (0..one).map(|k| factor[one][k] * at[k]).sum::<f64>();
                at[one] = (at[one] - known) / factor[one][one];
            }
            for one in (0..COUNT).rev() {
                let known = (one + 1..COUNT).map(|k| factor[k][one] * at[k]).sum::<f64>();
                at[one] = (at[one] - known) / factor[one][one];
            }
            at
        };
        Some(std::array::from_fn(column))
    }
}

/// The product of a symmetric matrix and a vector.
pub fn product(matrix: &[[f64; COUNT]; COUNT], vector: [f64; COUNT]) -> [f64; COUNT] {
    matrix.map(|row| row.iter().zip(vector).map(|(one, other)| one * other).sum())
}

#[cfg(test)]
mod tests {
    use super::{Quadratic, product};

    #[test]
    fn the_minimum_of_a_known_quadratic_is_found() {
        // Two places with different derivatives determine all four parameters.
        let motions = [
            [[1.0, 0.0, 0.5, 2.0], [0.0, 1.0, -2.0, 0.5]],
            [[1.0, 0.0, -1.0, 0.3], [0.0, 1.0, -0.3, -1.0]],
        ];
        let minimum = [0.3, -0.2, 0.1, 0.05];
        let mut sum = Quadratic::default();
        for (motion, centre) in motions.into_iter().zip([[0.0, 0.0], [0.5, -0.3]]) {
            let at = motion
                .map(|axis: [f64; 4]| axis.iter().zip(minimum).map(|(a, b)| a * b).sum::<f64>());
            let value = |place: usize| {
                let row = (place / 3) as f64 - 1.0 + centre[0] - at[0];
                let column = (place % 3) as f64 - 1.0 + centre[1] - at[1];
                3.0 * row * row + column * column + 0.5 * row * column
            };
            sum.add(&Quadratic::fit(value, motion, centre));
        }
        let found = product(&sum.inverse().unwrap(), sum.gradient).map(|value| -value);
        assert!(
            found.iter().zip(minimum).all(|(one, other)| (one - other).abs() < 1e-9),
            "{found:?}"
        );
        assert!(sum.gradient_at(minimum).iter().all(|value| value.abs() < 1e-9));
        let hill = Quadratic::fit(|place| -((place as f64 - 4.0).powi(2)), motions[0], [0.0; 2]);
        assert!(hill.inverse().is_none());
    }
}
