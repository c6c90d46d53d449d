//! `toile codec decode-bench`.

use anyhow::Result;
use explorer::decode_bench::{COLUMNS, DecodeReport, OPERATOR, VERTICES, run as measure};

use crate::{args, format};

/// Measures on this thread and prints.
pub fn run(a: &args::DecodeBench) -> Result<()> {
    let report = measure(a.other_mb as usize)?;
    if a.json {
        return format::print_json(&report);
    }
    print(&report);
    Ok(())
}

fn print(r: &DecodeReport) {
    let ([wide, narrow], [fine, coarse]) = (COLUMNS, OPERATOR);
    println!(
        "{}, one thread, medians; memory reads at {:.1} GB/s cold, {:.1} GB/s hot", //
        r.instructions, r.read_gb_s, r.read_hot_gb_s
    );
    println!("cold: {} MiB of other memory read before each call", r.other_mb);
    println!("{:<46} {:>9} {:>9}", "us", "hot", "cold");
    let line = |name: &str, hot: f64, cold: Option<f64>| {
        let cold = cold.map_or(String::new(), |us| format!("{us:.0}"));
        println!("{name:<46} {hot:>9.0} {cold:>9}");
    };
    let basis = format!("{VERTICES} vertices, {wide} x i16 + {narrow} x i8");
    line(&basis, r.mixed_hot_us, Some(r.mixed_cold_us));
    line(
        "  as a fraction of the read bandwidth (%)",
        100.0 * r.fraction_of_read_bandwidth_hot, //
        Some(100.0 * r.fraction_of_read_bandwidth_cold),
    );
    line("  four characters together", r.mixed_batch4_us, None);
    line(&format!("{} x i8", wide + narrow), r.i8_hot_us, Some(r.i8_cold_us));
    line("  four characters together", r.i8_batch4_us, Some(r.i8_batch4_cold_us));
    line("  sixteen characters together", r.i8_batch16_us, None);
    line("normals of all vertices", r.normals_us, None);
    line("faer, f32", r.faer_us, None);
    line("plain loop, f32", r.plain_us, None);
    let operator = format!("operator {fine} x {coarse}, 8-bit weights");
    line(&operator, r.operator_hot_us, Some(r.operator_cold_us));
    line("  f32 weights", r.operator_f32_hot_us, Some(r.operator_f32_cold_us));
    println!("operator's 8-bit weights: within {:.2} mm of f64", r.operator_error_mm);
}
