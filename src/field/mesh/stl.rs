//! STL, binary and text. Its triangles share no vertices; merging equal places restores the mesh.

use super::text::Words;
use super::{FieldError, MAX_TRIANGLES, Soup, limit, malformed};

const FORMAT: &str = "stl";
/// 80 bytes of anything, then the number of triangles as a little-endian `u32`.
const HEADER: usize = 84;
/// A normal, three corners of three `f32` each, and two spare bytes.
const RECORD: usize = 50;

/// Number of triangles, when the file is as long as its binary header says.
fn binary(bytes: &[u8]) -> Option<usize> {
    let count = u32::from_le_bytes(*bytes.get(80..)?.first_chunk()?) as usize;
    (bytes.len() == HEADER + count.checked_mul(RECORD)?).then_some(count)
}

pub(super) fn claims(bytes: &[u8]) -> bool {
    // a binary file may begin with "solid" as well, so its length decides
    binary(bytes).is_some() || bytes.starts_with(b"solid") && bytes.get(5).is_none_or(u8::is_ascii_whitespace)
}

pub(super) fn read(bytes: &[u8]) -> Result<Soup, FieldError> {
    let mut soup = Soup::new(FORMAT);
    let Some(count) = binary(bytes) else {
        return text(bytes, soup);
    };
    if count > MAX_TRIANGLES {
        return Err(limit("triangles of a mesh", count, MAX_TRIANGLES));
    }
    for triangle in 0..count {
        for corner in 0..3 {
            let at = HEADER + triangle * RECORD + 12 + 12 * corner;
            let mut position = [0.0; 3];
            for (axis, value) in position.iter_mut().enumerate() {
                let start = at + 4 * axis;
                *value =
                    f64::from(f32::from_le_bytes([bytes[start], bytes[start + 1], bytes[start + 2], bytes[start + 3]]));
            }
            soup.vertex(position, at)?;
        }
        let first = 3 * triangle as u32;
        soup.polygon(&[first, first + 1, first + 2])?;
    }
    Ok(soup)
}

fn text(bytes: &[u8], mut soup: Soup) -> Result<Soup, FieldError> {
    let mut words = Words::new(FORMAT, bytes, 0, bytes.len());
    let mut in_loop = 0;
    let mut ended = false;
    while let Some((at, word)) = words.next() {
        match word {
            b"vertex" => {
                let position = [words.number("x")?, words.number("y")?, words.number("z")?];
                soup.vertex(position, at)?;
                in_loop += 1;
            }
            b"endloop" => {
                if in_loop != 3 {
                    return Err(malformed(FORMAT, Some(at), format!("a loop has {in_loop} vertices instead of 3")));
                }
                let end = soup.vertices.len() as u32;
                soup.polygon(&[end - 3, end - 2, end - 1])?;
                in_loop = 0;
            }
            // the name behind these may be any words
            b"solid" | b"endsolid" => {
                ended = word == b"endsolid";
                words.skip_line();
            }
            _ => {}
        }
    }
    if in_loop != 0 || !ended {
        return Err(malformed(FORMAT, Some(bytes.len()), "the text ends before endsolid"));
    }
    Ok(soup)
}
