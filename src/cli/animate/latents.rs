//! The file of latent codes that an animation goes through.

use crate::field::FieldError;
use crate::field::grid::npy;
use crate::field::network::MAX_LATENT;
use serde::Deserialize;

/// Most frames of an animation: an hour and more of wrapping for any network, and what a GLB has room for.
pub const MAX_FRAMES: usize = 1000;

/// A latent code, or the row of one that comes with the network.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(untagged)]
pub enum Entry {
    /// The row, from 0.
    Row(u32),
    /// The code itself.
    Code(Vec<f32>),
}

/// What the file holds.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(untagged, deny_unknown_fields)]
enum Latents {
    /// One entry for every frame.
    Each(Vec<Entry>),
    /// The straight way between two.
    Between {
        /// The first frame's.
        from: Entry,
        /// The last frame's.
        to: Entry,
        /// How many frames, those two included.
        frames: usize,
    },
}

/// Reads the codes of all frames; `code` looks an entry up in the network.
///
/// # Errors
/// What is wrong with the file, or with the entry that is named by its place.
pub fn read(bytes: &[u8], code: impl Fn(&Entry) -> Result<Vec<f32>, FieldError>) -> Result<Vec<Vec<f32>>, String> {
    let latents: Latents = match npy::rows(bytes, MAX_FRAMES * MAX_LATENT) {
        Some(rows) => Latents::Each(rows.map_err(|e| e.to_string())?.into_iter().map(Entry::Code).collect()),
        None => serde_json::from_slice(bytes).map_err(|e| {
            let expected = "a .npy array of latent codes, a list of latent codes or rows, \
                            or {\"from\": code or row, \"to\": code or row, \"frames\": number}";
            format!("expected {expected} ({e})")
        })?,
    };
    let frames = match &latents {
        Latents::Each(list) => list.len(),
        Latents::Between { frames, .. } => *frames,
    };
    if !(2..=MAX_FRAMES).contains(&frames) {
        return Err(format!("there are {frames} frames, and an animation has 2 to {MAX_FRAMES}"));
    }
    let look_up = |place: &str, entry: &Entry| code(entry).map_err(|e| format!("{place}: {e}"));
    match latents {
        Latents::Each(list) => {
            list.iter().enumerate().map(|(i, entry)| look_up(&format!("frame {i}"), entry)).collect()
        }
        Latents::Between { from, to, .. } => {
            let (from, to) = (look_up("from", &from)?, look_up("to", &to)?);
            let between = |i: usize| {
                let t = i as f64 / (frames - 1) as f64;
                // both ends are met to the bit
                let mixed = |(&a, &b): (&f32, &f32)| (f64::from(a) * (1.0 - t) + f64::from(b) * t) as f32;
                from.iter().zip(&to).map(mixed).collect()
            };
            Ok((0..frames).map(between).collect())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn codes(text: &str) -> Result<Vec<Vec<f32>>, String> {
        read(text.as_bytes(), |entry| match entry {
            Entry::Row(row) if *row < 3 => Ok(vec![*row as f32, -1.0]),
            Entry::Row(_) => Err(FieldError::Unsupported { detail: "no such row".to_owned() }),
            Entry::Code(code) => Ok(code.clone()),
        })
    }

    #[test]
    fn codes_are_listed_by_value_or_by_row() {
        assert_eq!(codes("[[0.5, 1], 2, [0, 0]]"), Ok(vec![vec![0.5, 1.0], vec![2.0, -1.0], vec![0.0, 0.0]]));
    }

    #[test]
    fn an_array_of_numpy_is_a_list_of_codes() {
        let array = |shape: &str, numbers: &[f64]| {
            let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n");
            let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
            bytes.extend((header.len() as u16).to_le_bytes());
            bytes.extend(header.as_bytes());
            bytes.extend(numbers.iter().flat_map(|n| n.to_le_bytes()));
            read(&bytes, |entry| match entry {
                Entry::Code(code) => Ok(code.clone()),
                Entry::Row(_) => Err(FieldError::Unsupported { detail: "a row".to_owned() }),
            })
        };
        let codes = vec![vec![0.5, 1.0], vec![2.0, -1.0]];
        assert_eq!(array("(2, 2)", &[0.5, 1.0, 2.0, -1.0]), Ok(codes.clone()));
        assert_eq!(array("(2, 1, 2)", &[0.5, 1.0, 2.0, -1.0]), Ok(codes));
        assert!(array("(4,)", &[0.5, 1.0, 2.0, -1.0]).is_err_and(|e| e.contains("shape [4]")));
        assert!(array("(2, 2)", &[0.5]).is_err());
    }

    #[test]
    fn a_straight_way_meets_both_its_ends() {
        let way = codes(r#"{"from": [0.1, 0.7], "to": 2, "frames": 5}"#).expect("reads");
        assert_eq!((way.len(), &way[0], &way[4]), (5, &vec![0.1, 0.7], &vec![2.0, -1.0]));
        assert!((way[2][0] - 1.05).abs() < 1e-6 && (way[2][1] + 0.15).abs() < 1e-6, "{way:?}");
    }

    #[test]
    fn what_is_wrong_is_said_by_its_place() {
        for (text, said) in [
            ("[[0, 0], 3]", "frame 1: unsupported: no such row"),
            (r#"{"from": 7, "to": 1, "frames": 2}"#, "from: "),
            (r#"{"from": 0, "to": 1}"#, "expected a .npy array"),
            (r#"{"from": 0, "to": 1, "frames": 2, "fps": 3}"#, "expected a .npy array"),
            ("[0]", "1 frames"),
            (r#"{"from": 0, "to": 1, "frames": 1001}"#, "2 to 1000"),
            ("[0, -1]", "expected a .npy array"),
            ("nonsense", "expected a .npy array"),
        ] {
            let found = codes(text).expect_err("is refused");
            assert!(found.contains(said), "{text}: {found}");
        }
    }
}
