use super::*;

const TRIANGLES: [[u32; 3]; 2] = [[0, 1, 2], [2, 1, 3]];

fn frames(count: usize) -> Vec<Vec<Vec3>> {
    let corner = |frame: usize, k: usize| {
        Vec3::new((k % 2) as f32, 0.1 * (frame * k) as f32, (k / 2) as f32 - 0.3 * frame as f32)
    };
    (0..count).map(|frame| (0..4).map(|k| corner(frame, k)).collect()).collect()
}

fn mesh<'a>(name: &'a str, frames: &'a [Vec<Vec3>]) -> ClipMesh<'a> {
    ClipMesh { name, triangles: &TRIANGLES, frames, colour: [255, 0, 10], two_sided: true }
}

/// The two chunks, after checking the frame around them.
fn open(file: &[u8]) -> (Value, &[u8]) {
    let word = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!(&file[..4], b"glTF");
    assert_eq!((word(4), word(8)), (2, file.len()));
    let text = word(12);
    assert_eq!((&file[16..20], text % 4), (&b"JSON"[..], 0));
    let binary = 20 + text;
    assert_eq!(&file[binary + 4..binary + 8], b"BIN\0");
    assert_eq!(binary + 8 + word(binary), file.len());
    (serde_json::from_slice(&file[20..binary]).unwrap(), &file[binary + 8..])
}

/// The floats of an accessor, after checking its extent and bounds.
fn floats(root: &Value, binary: &[u8], accessor: &Value) -> Vec<f32> {
    let accessor = &root["accessors"][accessor.as_u64().unwrap() as usize];
    let view = &root["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
    let number = |value: &Value| value.as_u64().unwrap() as usize;
    let (start, length) = (number(&view["byteOffset"]), number(&view["byteLength"]));
    let width = if accessor["type"] == "VEC3" { 3 } else { 1 };
    assert_eq!((start % 4, length), (0, 4 * width * number(&accessor["count"])));
    let bytes = binary[start..start + length].chunks(4);
    let values: Vec<f32> = bytes.map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    for axis in 0..width {
        let column = || values.iter().skip(axis).step_by(width).copied().map(f64::from);
        assert_eq!(accessor["min"][axis].as_f64(), column().reduce(f64::min));
        assert_eq!(accessor["max"][axis].as_f64(), column().reduce(f64::max));
    }
    values
}

#[test]
fn every_frame_is_restored_at_its_time() {
    let frames = frames(5);
    let meshes = [mesh("body", &frames), mesh("skirt \"a\"", &frames)];
    let file = glb(&Clip { rate: 30.0, normals: true, meshes: &meshes }).unwrap();
    let (root, binary) = open(&file);
    assert_eq!(root["meshes"][1]["name"], "skirt \"a\"");
    assert_eq!(root["animations"][0]["channels"].as_array().unwrap().len(), 2);
    let sampler = &root["animations"][0]["samplers"][0];
    let times = floats(&root, binary, &sampler["input"]);
    let weights = floats(&root, binary, &sampler["output"]);
    assert_eq!((times.len(), weights.len()), (5, 20));
    let primitive = &root["meshes"][1]["primitives"][0];
    let base = floats(&root, binary, &primitive["attributes"]["POSITION"]);
    assert_eq!(floats(&root, binary, &primitive["attributes"]["NORMAL"]).len(), 12);
    for (frame, positions) in frames.iter().enumerate() {
        assert!((times[frame] - frame as f32 / 30.0).abs() < 1e-6);
        let mut shown = base.clone();
        for target in 0..4 {
            let weight = weights[frame * 4 + target];
            let change = floats(&root, binary, &primitive["targets"][target]["POSITION"]);
            shown.iter_mut().zip(change).for_each(|(value, change)| *value += weight * change);
        }
        let expected = positions.iter().flat_map(|position| position.to_array());
        for (value, expected) in shown.iter().zip(expected) {
            assert!((value - expected).abs() < 1e-6, "frame {frame}: {value}, not {expected}");
        }
    }
}

#[test]
fn a_still_has_no_animation() {
    let frames = frames(1);
    let file = glb(&Clip { rate: 30.0, normals: false, meshes: &[mesh("a", &frames)] }).unwrap();
    let (root, binary) = open(&file);
    assert!(root.get("animations").is_none() && root["meshes"][0].get("weights").is_none());
    assert_eq!(binary.len(), 4 * 12 + 2 * 12);
    assert_eq!(root["buffers"][0]["byteLength"], binary.len());
}

#[test]
fn broken_clips_are_refused() {
    let good = frames(3);
    let refused = |meshes: &[ClipMesh<'_>]| {
        glb(&Clip { rate: 30.0, normals: false, meshes }).expect_err("a broken clip was written")
    };
    assert!(matches!(refused(&[]), GlbError::Empty));
    assert!(matches!(refused(&[mesh("a", &[])]), GlbError::Extent { frames: 0, .. }));
    let long = vec![good[0].clone(); FRAMES_MAX + 1];
    assert!(matches!(refused(&[mesh("a", &long)]), GlbError::Extent { .. }));
    let fewer = mesh("b", &good[..2]);
    assert!(matches!(refused(&[mesh("a", &good), fewer]), GlbError::Uneven { .. }));
    let mut short = good.clone();
    short[2].pop();
    assert!(matches!(refused(&[mesh("a", &short)]), GlbError::Uneven { frame: 2, .. }));
    let mut wild = good.clone();
    wild[1][3].y = f32::NAN;
    assert!(matches!(refused(&[mesh("a", &wild)]), GlbError::NotFinite { vertex: 3, .. }));
    let outside = ClipMesh { triangles: &[[0, 1, 4]], ..mesh("a", &good) };
    assert!(matches!(refused(&[outside]), GlbError::Vertex { triangle: 0, .. }));
    let stopped = glb(&Clip { rate: 0.0, normals: false, meshes: &[mesh("a", &good)] });
    assert!(matches!(stopped, Err(GlbError::Rate(_))));
}
