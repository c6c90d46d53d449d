use super::*;

fn labels(axis: &Axis) -> Vec<&str> {
    axis.ticks.iter().map(|tick| tick.label.as_str()).collect()
}

#[test]
fn ticks_are_round_numbers() {
    let axis = Axis::linear([0.3, 9.7], 0.0, 300.0);
    assert_eq!(labels(&axis), ["0", "2", "4", "6", "8", "10"]);
    let axis = Axis::linear([1.0, 41_000.0], 0.0, 300.0);
    assert_eq!(labels(&axis), ["0", "10k", "20k", "30k", "40k", "50k"]);
    let axis = Axis::linear([-0.011, 0.012], 0.0, 120.0);
    assert_eq!(labels(&axis), ["-0.02", "-0.01", "0", "0.01", "0.02"]);
    let axis = Axis::logarithmic([0.03, 4200.0], 300.0, 0.0);
    assert_eq!(labels(&axis), ["0.01", "0.1", "1", "10", "100", "1000", "10k"]);
    let axis = Axis::logarithmic([3.0, 21.0], 300.0, 0.0);
    assert_eq!(labels(&axis), ["2", "5", "10", "20", "50"]);
}

#[test]
fn values_stand_where_they_belong() {
    let axis = Axis::linear([0.0, 10.0], 100.0, 200.0);
    assert!((axis.place(5.0) - 150.0).abs() < 1e-4);
    let axis = Axis::logarithmic([1.0, 10_000.0], 400.0, 0.0);
    assert!((axis.place(100.0) - 200.0).abs() < 1e-3);
}

#[test]
fn strange_values_make_gaps() {
    let points = vec![[0.0, 1.0], [1.0, 2.0], [2.0, f64::NAN], [3.0, 4.0], [4.0, 0.0], [5.0, 3.0]];
    let lines = |plot: &Plot| plot.svg().matches("stroke-width=\"1.8\"").count();
    let plot = Plot::new("t", "x", "y").with("", points);
    assert_eq!(lines(&plot), 2);
    assert_eq!(lines(&plot.logarithmic()), 3);
    for points in [vec![], vec![[f64::NAN; 2]], vec![[1e300, -1e300]], vec![[7.0, 7.0]]] {
        for log in [false, true] {
            let plot = Plot { y_log: log, ..Plot::new("t", "x", "y").with("a", points.clone()) };
            assert!(!plot.svg().contains("NaN") && !plot.svg().contains("inf"), "{points:?}");
            assert!(plot.image(1).is_ok());
        }
    }
}

#[test]
fn the_line_is_in_the_picture_and_its_name_in_the_legend() {
    let falling = (1..200).map(|k| [f64::from(k), 50.0 / f64::from(k)]).collect();
    let flat = (1..200).map(|k| [f64::from(k), 3.0]).collect();
    let plot = Plot::new("Worst <error>", "frames", "mm").with("ours & theirs", falling);
    let plot = plot.with("flat", flat).logarithmic();
    let svg = plot.svg();
    assert!(svg.contains("Worst &lt;error&gt;") && svg.contains("ours &amp; theirs"));
    let image = Image::from_png(&plot.png(2).unwrap()).unwrap();
    assert_eq!((image.width(), image.height()), (1280, 720));
    for colour in &COLOURS[..2] {
        let drawn = image.pixels().iter().filter(|pixel| *pixel == colour).count();
        assert!(drawn > 1000, "{drawn} pixels of {colour:?}");
    }
}

#[test]
fn stages_stand_where_they_were_reached_and_not_beyond() {
    let plot = Plot::new("t", "x", "y").with("", vec![[0.0, 1.0], [100.0, 2.0]]);
    let svg = plot.at_stage(25.0, "early").at_stage(75.0, "late").at_stage(900.0, "never").svg();
    assert!(svg.contains("early") && svg.contains("late") && !svg.contains("never"));
    assert_eq!(svg.matches("#96989e").count(), 4, "{svg}");
}

#[test]
fn thinning_keeps_every_peak() {
    let mut points: Vec<_> = (0..100_000).map(|k| [f64::from(k), 1.0]).collect();
    points[77_777][1] = 9.0;
    points[50_000][1] = f64::NAN;
    let kept = thinned(&points, 500);
    assert!(kept.len() <= 1002 && kept.contains(&[77_777.0, 9.0]));
    assert!(kept.windows(2).all(|pair| pair[0][0] <= pair[1][0]));
}
