//! Wavefront OBJ: `v` and `f` lines, corners as `v`, `v/vt`, `v//vn` or `v/vt/vn`, negative indices counted from the end.
//!
//! Texture coordinates, normals, groups, materials and smoothing are walked over; free-form surfaces are refused.

use super::text::{Words, lines, parse};
use super::{FieldError, MAX_CORNERS, Soup, limit, malformed};

const FORMAT: &str = "obj";
/// Lines looked at to tell an OBJ from other text.
const LINES_TO_JUDGE: usize = 200;

/// Whether the first lines are made of OBJ keywords and one of them is a vertex.
pub(super) fn claims(bytes: &[u8]) -> bool {
    const KNOWN: [&[u8]; 14] =
        [b"v", b"vt", b"vn", b"vp", b"f", b"g", b"o", b"s", b"l", b"p", b"usemtl", b"mtllib", b"cstype", b"#"];
    let head = &bytes[..bytes.len().min(64 * 1024)];
    if head.contains(&0) {
        return false;
    }
    let mut vertices = 0;
    for (at, line) in lines(head).take(LINES_TO_JUDGE) {
        let Some((_, word)) = Words::new(FORMAT, head, at, at + line.len()).next() else { continue };
        if !word.starts_with(b"#") && !KNOWN.contains(&word) {
            return false;
        }
        vertices += usize::from(word == b"v");
    }
    // a long preamble of comments may hide the first vertex
    vertices > 0 || head.starts_with(b"#") && head.windows(3).any(|w| w == b"\nv ")
}

pub(super) fn read(bytes: &[u8]) -> Result<Soup, FieldError> {
    let mut soup = Soup::new(FORMAT);
    // a face may name vertices that follow it, so faces wait until all vertices are known
    let mut pending: Vec<(usize, usize, i64)> = Vec::new();
    for (at, line) in lines(bytes) {
        let mut words = Words::new(FORMAT, bytes, at, at + line.len());
        let Some((_, keyword)) = words.next() else { continue };
        match keyword {
            b"v" => {
                let position = [words.number("x")?, words.number("y")?, words.number("z")?];
                soup.vertex(position, at)?;
            }
            b"f" => pending.push((words.position(), at + line.len(), soup.vertices.len() as i64)),
            b"curv" | b"surf" | b"cstype" => {
                let detail = format!("the OBJ statement {}", String::from_utf8_lossy(keyword));
                return Err(FieldError::Unsupported { detail });
            }
            _ => {}
        }
    }
    let mut corners = Vec::new();
    for (from, to, known) in pending {
        corners.clear();
        let mut words = Words::new(FORMAT, bytes, from, to);
        while let Some((at, word)) = words.next() {
            if word.starts_with(b"#") {
                break;
            }
            let index = word.split(|&b| b == b'/').next().and_then(parse::<i64>);
            let index = index.ok_or_else(|| malformed(FORMAT, Some(at), "a corner is not a whole number"))?;
            let absolute = if index < 0 { known.checked_add(index) } else { index.checked_sub(1) };
            match absolute.and_then(|i| usize::try_from(i).ok()).filter(|&i| i < soup.vertices.len()) {
                Some(index) => corners.push(index as u32),
                None => return Err(malformed(FORMAT, Some(at), format!("no vertex has the index {index}"))),
            }
            if corners.len() > MAX_CORNERS {
                return Err(limit("corners of a polygon", corners.len(), MAX_CORNERS));
            }
        }
        if corners.len() < 3 {
            return Err(malformed(FORMAT, Some(from), "a face has fewer than three corners"));
        }
        soup.polygon(&corners)?;
    }
    Ok(soup)
}
