//! Vertex errors: largest, root mean square, percentiles.

/// Vertex errors, in bins of 3 %.
#[derive(Debug, Clone)]
pub struct Errors {
    bins: Vec<u64>,
    max: f64,
    square: f64,
    count: u64,
}

impl Default for Errors {
    fn default() -> Self {
        Self { bins: vec![0; 1024], max: 0.0, square: 0.0, count: 0 }
    }
}

impl Errors {
    /// Compares positions (m), three numbers a vertex.
    pub fn compare(&mut self, exact: &[f32], decoded: &[f32]) {
        for (exact, decoded) in exact.chunks_exact(3).zip(decoded.chunks_exact(3)) {
            let square: f64 =
                (0..3).map(|i| (f64::from(exact[i]) - f64::from(decoded[i])).powi(2)).sum();
            self.square += square;
            self.count += 1;
            let distance = square.sqrt();
            self.max = self.max.max(distance);
            // Bin 0 ends at a nanometre.
            let bin = ((distance / 1e-9).max(1.0).ln() / 1.03f64.ln()) as usize;
            self.bins[bin.min(1023)] += 1;
        }
    }

    /// Largest (m).
    pub fn max_m(&self) -> f64 {
        self.max
    }

    /// Root mean square (m).
    pub fn rms_m(&self) -> f64 {
        (self.square / self.count.max(1) as f64).sqrt()
    }

    /// The error that this share of all vertices does not exceed (m), to 3 %.
    pub fn quantile_m(&self, share: f64) -> f64 {
        let wanted = (share * self.count as f64).ceil() as u64;
        let mut met = 0;
        let reached = |count: &u64| {
            met += count;
            met >= wanted
        };
        let bin = self.bins.iter().position(reached).unwrap_or(1023);
        (1e-9 * 1.03f64.powi(bin as i32 + 1)).min(self.max)
    }
}
