//! Numbers as people and machines read them.

use anyhow::{Context, Result};

/// Prints one JSON object as the last line of stdout.
pub fn print_json(value: &impl serde::Serialize) -> Result<()> {
    println!("{}", serde_json::to_string(value).context("writing JSON")?);
    Ok(())
}

/// Bytes with a unit: `812 B`, `3.4 kB`, `61.0 MB`.
pub fn bytes(count: u64) -> String {
    let units = [(1_000_000_000, "GB"), (1_000_000, "MB"), (1_000, "kB")];
    match units.iter().find(|(size, _)| count >= *size) {
        Some((size, unit)) => format!("{:.1} {unit}", count as f64 / *size as f64),
        None => format!("{count} B"),
    }
}

/// Metres as millimetres.
pub fn mm(metres: f32) -> f64 {
    f64::from(metres) * 1000.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_carry_their_unit() {
        assert_eq!(bytes(812), "812 B");
        assert_eq!(bytes(3_400), "3.4 kB");
        assert_eq!(bytes(61_000_000), "61.0 MB");
    }
}
