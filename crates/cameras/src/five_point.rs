//! Essential matrices from five pairs of rays (Nistér, "An efficient solution to the five-point
//! relative pose problem", 2004), and what they say of the pose.

use nalgebra::{Matrix3, SMatrix, SVector, Vector2, Vector3};

use crate::{
    pose::Pose,
    roots::{DEGREE_MAX, real_roots},
};

/// Exponents of x, y, z of the twenty monomials, in the order of the elimination.
const MONOMIALS: [[u8; 3]; 20] = [
    [3, 0, 0],
    [0, 3, 0],
    [2, 1, 0],
    [1, 2, 0],
    [2, 0, 1],
    [2, 0, 0],
    [0, 2, 1],
    [0, 2, 0],
    [1, 1, 1],
    [1, 1, 0],
    [1, 0, 2],
    [1, 0, 1],
    [1, 0, 0],
    [0, 1, 2],
    [0, 1, 1],
    [0, 1, 0],
    [0, 0, 3],
    [0, 0, 2],
    [0, 0, 1],
    [0, 0, 0],
];

/// Index of a monomial by its exponents.
const INDEX: [[[u8; 4]; 4]; 4] = {
    let mut index = [[[u8::MAX; 4]; 4]; 4];
    let mut i = 0;
    while i < 20 {
        let [x, y, z] = MONOMIALS[i];
        index[x as usize][y as usize][z as usize] = i as u8;
        i += 1;
    }
    index
};

/// Index of the product of two monomials of at most degree 3 together.
const PRODUCT: [[u8; 20]; 20] = {
    let mut product = [[u8::MAX; 20]; 20];
    let mut i = 0;
    while i < 20 {
        let mut j = 0;
        while j < 20 {
            let (a, b) = (MONOMIALS[i], MONOMIALS[j]);
            let (x, y, z) = (a[0] + b[0], a[1] + b[1], a[2] + b[2]);
            if x + y + z <= 3 {
                product[i][j] = INDEX[x as usize][y as usize][z as usize];
            }
            j += 1;
        }
        i += 1;
    }
    product
};

/// Monomials of degree 1 and less, and of degree 2 and less.
const LINEAR: [usize; 4] = [12, 15, 18, 19];
const QUADRATIC: [usize; 10] = [5, 7, 9, 11, 12, 14, 15, 17, 18, 19];

type Poly = [f64; 20];

fn linear_times_linear(a: &Poly, b: &Poly, sum: &mut Poly, sign: f64) {
    for i in LINEAR {
        for j in LINEAR {
            sum[PRODUCT[i][j] as usize] += sign * a[i] * b[j];
        }
    }
}

fn quadratic_times_linear(a: &Poly, b: &Poly, sum: &mut Poly, sign: f64) {
    for i in QUADRATIC {
        for j in LINEAR {
            sum[PRODUCT[i][j] as usize] += sign * a[i] * b[j];
        }
    }
}

/// Four orthonormal vectors at right angles to five of nine numbers.
fn null_space(rows: [SVector<f64, 9>; 5]) -> Option<[SVector<f64, 9>; 4]> {
    let mut basis: Vec<SVector<f64, 9>> = Vec::with_capacity(9);
    let away = |mut v: SVector<f64, 9>, basis: &[SVector<f64, 9>]| {
        for _ in 0..2 {
            for b in basis {
                v -= b * b.dot(&v);
            }
        }
        v
    };
    for row in rows {
        let rest = away(row, &basis);
        let length = rest.norm();
        if length <= 1e-9 * row.norm() || !length.is_finite() {
            return None;
        }
        basis.push(rest / length);
    }
    for _ in 0..4 {
        let unit = |k: usize| SVector::<f64, 9>::from_fn(|i, _| f64::from(u8::from(i == k)));
        let left = |k: usize| 1.0 - basis.iter().map(|b| b[k] * b[k]).sum::<f64>();
        let k = (0..9).max_by(|&a, &b| left(a).total_cmp(&left(b)))?;
        basis.push(away(unit(k), &basis).normalize());
    }
    Some([basis[5], basis[6], basis[7], basis[8]])
}

/// Essential matrices with `x2ᵀ E x1 = 0` for five pairs of points on the plane z = 1.
pub(crate) fn essentials(first: [Vector2<f64>; 5], second: [Vector2<f64>; 5]) -> Vec<Matrix3<f64>> {
    let rows = std::array::from_fn(|i| {
        let (a, b) = (first[i], second[i]);
        SVector::<f64, 9>::from([
            b.x * a.x,
            b.x * a.y,
            b.x,
            b.y * a.x,
            b.y * a.y,
            b.y,
            a.x,
            a.y,
            1.0,
        ])
    });
    let Some(basis) = null_space(rows) else { return Vec::new() };
    // Entry (r, c) of E as a polynomial of degree one in x, y, z.
    let entry: [Poly; 9] = std::array::from_fn(|k| {
        let mut p = [0.0; 20];
        for (monomial, vector) in LINEAR.iter().zip(&basis) {
            p[*monomial] = vector[k];
        }
        p
    });
    let mut system = SMatrix::<f64, 10, 20>::zeros();
    let mut set_row = |row: usize, p: &Poly| {
        for (column, value) in p.iter().enumerate() {
            system[(row, column)] = *value;
        }
    };
    // det E = 0.
    let mut det = [0.0; 20];
    for (a, b, c) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
        let mut minor = [0.0; 20];
        linear_times_linear(&entry[3 + b], &entry[6 + c], &mut minor, 1.0);
        linear_times_linear(&entry[3 + c], &entry[6 + b], &mut minor, -1.0);
        quadratic_times_linear(&minor, &entry[a], &mut det, 1.0);
    }
    set_row(0, &det);
    // E Eᵀ E - trace(E Eᵀ) E / 2 = 0.
    let mut gram = [[[0.0; 20]; 3]; 3];
    for r in 0..3 {
        for c in 0..3 {
            for k in 0..3 {
                linear_times_linear(&entry[3 * r + k], &entry[3 * c + k], &mut gram[r][c], 1.0);
            }
        }
    }
    let half_trace: Poly =
        std::array::from_fn(|i| 0.5 * (gram[0][0][i] + gram[1][1][i] + gram[2][2][i]));
    for (r, row) in gram.iter_mut().enumerate() {
        for (value, half) in row[r].iter_mut().zip(half_trace) {
            *value -= half;
        }
    }
    for (r, row) in gram.iter().enumerate() {
        for c in 0..3 {
            let mut p = [0.0; 20];
            for (k, value) in row.iter().enumerate() {
                quadratic_times_linear(value, &entry[3 * k + c], &mut p, 1.0);
            }
            set_row(1 + 3 * r + c, &p);
        }
    }
    if !eliminate(&mut system) {
        return Vec::new();
    }
    from_eliminated(&system, &basis)
}

/// Makes the first ten columns the identity, with row pivots.
fn eliminate(m: &mut SMatrix<f64, 10, 20>) -> bool {
    for column in 0..10 {
        let pivot = (column..10)
            .max_by(|&a, &b| m[(a, column)].abs().total_cmp(&m[(b, column)].abs()))
            .unwrap_or(column);
        if m[(pivot, column)].abs() < 1e-14 || !m[(pivot, column)].is_finite() {
            return false;
        }
        m.swap_rows(column, pivot);
        let scale = 1.0 / m[(column, column)];
        for k in column..20 {
            m[(column, k)] *= scale;
        }
        for row in 0..10 {
            let factor = m[(row, column)];
            if row != column && factor != 0.0 {
                for k in column..20 {
                    m[(row, k)] -= factor * m[(column, k)];
                }
            }
        }
    }
    true
}

/// The product of polynomials in z, added to `sum`.
fn add_product(a: &[f64], b: &[f64], sum: &mut [f64], sign: f64) {
    for (i, x) in a.iter().enumerate() {
        for (j, y) in b.iter().enumerate() {
            sum[i + j] += sign * x * y;
        }
    }
}

fn from_eliminated(m: &SMatrix<f64, 10, 20>, basis: &[SVector<f64, 9>; 4]) -> Vec<Matrix3<f64>> {
    // Three rows of polynomials in z that take (x, y, 1) to 0.
    let b: [[Vec<f64>; 3]; 3] = [(4, 5), (6, 7), (8, 9)].map(|(e, f)| {
        let part = |from: usize, degree: usize| -> Vec<f64> {
            (0..=degree + 1)
                .map(|power| {
                    // Columns go from the highest power of z down to the constant.
                    let own = if power <= degree { m[(e, from + degree - power)] } else { 0.0 };
                    let times_z = if power > 0 { m[(f, from + degree + 1 - power)] } else { 0.0 };
                    own - times_z
                })
                .collect()
        };
        [part(10, 2), part(13, 2), part(16, 3)]
    });
    let mut det = [0.0; DEGREE_MAX + 1];
    for (i, j, k) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
        let mut minor = [0.0; 8];
        add_product(&b[j][1], &b[k][2], &mut minor, 1.0);
        add_product(&b[j][2], &b[k][1], &mut minor, -1.0);
        add_product(&b[i][0], &minor, &mut det, 1.0);
    }
    let at = |p: &[f64], z: f64| p.iter().rev().fold(0.0, |sum, c| sum * z + c);
    let mut found = Vec::new();
    for z in real_roots(&det) {
        let row = |i: usize| Vector3::new(at(&b[i][0], z), at(&b[i][1], z), at(&b[i][2], z));
        let rows = [row(0), row(1), row(2)];
        let solution = [(0, 1), (1, 2), (0, 2)]
            .map(|(i, j)| rows[i].normalize().cross(&rows[j].normalize()))
            .into_iter()
            .max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()));
        let Some(solution) = solution else { continue };
        let (x, y) = (solution.x / solution.z, solution.y / solution.z);
        let e = basis[0] * x + basis[1] * y + basis[2] * z + basis[3];
        let e = e / e.norm();
        if e.iter().all(|v| v.is_finite()) {
            found.push(Matrix3::from_row_slice(e.as_slice()));
        }
    }
    found
}

/// The four poses of the second camera (the first is the identity, the distance 1) that an
/// essential matrix leaves open.
pub(crate) fn poses_of(e: &Matrix3<f64>) -> Option<[Pose; 4]> {
    let svd = e.try_svd(true, true, 1e-14, 200)?;
    let (mut u, mut v_t) = (svd.u?, svd.v_t?);
    // nalgebra orders the singular values from the largest down.
    if u.determinant() < 0.0 {
        u = -u;
    }
    if v_t.determinant() < 0.0 {
        v_t = -v_t;
    }
    let w = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    let (a, b) = (u * w * v_t, u * w.transpose() * v_t);
    let t: Vector3<f64> = u.column(2).into();
    Some([(a, t), (a, -t), (b, t), (b, -t)].map(|(r, t)| Pose { r, t }))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Vector2, Vector3};

    use super::{essentials, poses_of};
    use crate::{
        pose::{Pose, angle_deg, rotation},
        rng::Rng,
    };

    #[test]
    fn the_true_pose_is_among_those_of_five_pairs() {
        let mut rng = Rng::new(7, 0);
        let mut draw = || rng.below(1 << 20) as f64 / f64::from(1 << 20) * 2.0 - 1.0;
        for _ in 0..200 {
            let turn = Vector3::new(draw(), draw(), draw());
            let t = Vector3::new(draw(), draw(), draw()).normalize();
            let truth = Pose { r: rotation(&turn), t };
            let mut first = [Vector2::zeros(); 5];
            let mut second = [Vector2::zeros(); 5];
            for i in 0..5 {
                let p = Vector3::new(draw(), draw(), 4.0 + draw());
                let q = truth.seen(&p);
                first[i] = Vector2::new(p.x / p.z, p.y / p.z);
                second[i] = Vector2::new(q.x / q.z, q.y / q.z);
            }
            let best = essentials(first, second)
                .iter()
                .filter_map(poses_of)
                .flatten()
                .map(|pose| angle_deg(&(pose.r * truth.r.transpose())) + (pose.t - t).norm())
                .fold(f64::INFINITY, f64::min);
            assert!(best < 1e-2, "{best}");
        }
    }
}
