//! Real roots of polynomials.

/// Highest degree that is solved.
pub(crate) const DEGREE_MAX: usize = 10;

/// The value at `x` of the polynomial with coefficients from the constant up.
fn value(p: &[f64], x: f64) -> f64 {
    p.iter().rev().fold(0.0, |sum, c| sum * x + c)
}

/// Real roots of a polynomial of degree 1 to [`DEGREE_MAX`], coefficients from the constant up.
/// Roots of even multiplicity may be missed.
pub(crate) fn real_roots(p: &[f64]) -> Vec<f64> {
    let largest = p.iter().fold(0.0_f64, |m, c| m.max(c.abs()));
    if p.len() < 2 || p.len() > DEGREE_MAX + 1 || !largest.is_finite() || largest == 0.0 {
        return Vec::new();
    }
    let p: Vec<f64> = p.iter().map(|c| c / largest).collect();
    // Inside of [-1, 1], and outside of it by z = 1 / x.
    let mut roots = roots_between(&p);
    let reversed: Vec<f64> = p.iter().rev().copied().collect();
    let outside = roots_between(&reversed).into_iter().filter(|x| x.abs() < 1.0 && *x != 0.0);
    roots.extend(outside.map(|x| 1.0 / x).filter(|z| z.is_finite()));
    roots
}

/// Roots in [-1, 1]: between neighbouring roots of the derivative there is one at most.
fn roots_between(p: &[f64]) -> Vec<f64> {
    if p.len() < 2 {
        return Vec::new();
    }
    let slope: Vec<f64> = p.iter().enumerate().skip(1).map(|(i, c)| i as f64 * c).collect();
    let mut borders = vec![-1.0];
    borders.extend(roots_between(&slope));
    borders.push(1.0);
    let mut roots: Vec<f64> = Vec::new();
    for pair in borders.windows(2) {
        if let Some(root) = root_between(p, &slope, pair[0], pair[1])
            && roots.last().is_none_or(|last| *last < root)
        {
            roots.push(root);
        }
    }
    roots
}

/// The root of `p` in [low, high], where it is monotonic: Newton's steps, bisection where they
/// leave.
fn root_between(p: &[f64], slope: &[f64], mut low: f64, mut high: f64) -> Option<f64> {
    let (at_low, at_high) = (value(p, low), value(p, high));
    if at_low == 0.0 {
        return Some(low);
    }
    if at_high == 0.0 {
        return Some(high);
    }
    if (at_low > 0.0) == (at_high > 0.0) {
        return None;
    }
    let mut x = 0.5 * (low + high);
    for _ in 0..80 {
        let at = value(p, x);
        if at == 0.0 {
            return Some(x);
        }
        if (at > 0.0) == (at_low > 0.0) {
            low = x;
        } else {
            high = x;
        }
        let newton = x - at / value(slope, x);
        let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
        if (next - x).abs() <= 1e-15 || high - low <= 1e-15 {
            return Some(next);
        }
        x = next;
    }
    Some(x)
}

#[cfg(test)]
mod tests {
    use super::real_roots;

    #[test]
    fn roots_of_a_product_of_factors_are_found() {
        let roots = [-7.5, -1.0, -0.2, 0.001, 0.3, 0.31, 2.0, 40.0];
        let mut p = vec![1.0];
        for root in roots {
            let mut next = vec![0.0; p.len() + 1];
            for (i, c) in p.iter().enumerate() {
                next[i + 1] += c;
                next[i] -= root * c;
            }
            p = next;
        }
        // Two complex ones.
        let mut with_complex = vec![0.0; p.len() + 2];
        for (i, c) in p.iter().enumerate() {
            with_complex[i] += c;
            with_complex[i + 2] += c;
        }
        let mut found = real_roots(&with_complex);
        found.sort_by(f64::total_cmp);
        assert_eq!(found.len(), roots.len(), "{found:?}");
        for (a, b) in found.iter().zip(roots) {
            assert!((a - b).abs() < 1e-8 * b.abs().max(1.0), "{a} is not {b}");
        }
    }

    #[test]
    fn nothing_is_found_in_numbers_that_are_none() {
        assert!(real_roots(&[f64::NAN, 1.0]).is_empty());
        assert!(real_roots(&[0.0, 0.0, 0.0]).is_empty());
        assert!(real_roots(&[1.0]).is_empty());
    }
}
