//! The Object File Format as text: `OFF`, and `COFF` and `NOFF`, whose further columns are walked over.

use super::text::{Words, lines, parse};
use super::{FieldError, MAX_CORNERS, MAX_TRIANGLES, MAX_VERTICES, Soup, limit, malformed};

const FORMAT: &str = "off";
const KEYWORDS: [&[u8]; 3] = [b"OFF", b"COFF", b"NOFF"];

pub(super) fn claims(bytes: &[u8]) -> bool {
    let first = Words::new(FORMAT, bytes, 0, bytes.len().min(64)).next();
    // some writers put the counts right behind the keyword
    first.is_some_and(|(at, word)| at == 0 && (KEYWORDS.contains(&word) || glued(word).is_some()))
}

/// `OFF8` as some data sets have it: the keyword without the space behind it.
fn glued(word: &[u8]) -> Option<&[u8]> {
    word.strip_prefix(b"OFF").filter(|rest| !rest.is_empty() && rest.iter().all(u8::is_ascii_digit))
}

pub(super) fn read(bytes: &[u8]) -> Result<Soup, FieldError> {
    let mut soup = Soup::new(FORMAT);
    // lines with something on them, comments cut off
    let mut rows = lines(bytes).filter_map(|(at, line)| {
        let end = at + line.iter().position(|&b| b == b'#').unwrap_or(line.len());
        bytes[at..end].iter().any(|b| !b.is_ascii_whitespace()).then_some((at, end))
    });
    let ends = || malformed(FORMAT, Some(bytes.len()), "the text ends too early");
    let (at, end) = rows.next().ok_or_else(ends)?;
    let (keyword_at, keyword) = Words::new(FORMAT, bytes, at, end).required("the keyword OFF")?;
    let behind = keyword_at + if glued(keyword).is_some() { 3 } else { keyword.len() };
    let mut words = Words::new(FORMAT, bytes, behind, end);
    match words.clone().next() {
        Some((_, b"BINARY")) => return Err(FieldError::Unsupported { detail: "binary OFF".to_owned() }),
        Some(_) => {}
        None => {
            let (at, end) = rows.next().ok_or_else(ends)?;
            words = Words::new(FORMAT, bytes, at, end);
        }
    }
    let (vertices, faces) = (words.count("the number of vertices")?, words.count("the number of faces")?);
    if vertices > MAX_VERTICES {
        return Err(limit("vertices of a mesh", vertices, MAX_VERTICES));
    }
    if faces > MAX_TRIANGLES {
        return Err(limit("triangles of a mesh", faces, MAX_TRIANGLES));
    }
    for _ in 0..vertices {
        let (at, end) = rows.next().ok_or_else(ends)?;
        let mut words = Words::new(FORMAT, bytes, at, end);
        soup.vertex([words.number("x")?, words.number("y")?, words.number("z")?], at)?;
    }
    let mut corners = Vec::new();
    for _ in 0..faces {
        let (at, end) = rows.next().ok_or_else(ends)?;
        let mut words = Words::new(FORMAT, bytes, at, end);
        let n = words.count("the number of corners")?;
        if n > MAX_CORNERS {
            return Err(limit("corners of a polygon", n, MAX_CORNERS));
        }
        corners.clear();
        for _ in 0..n {
            let (at, word) = words.required("a corner")?;
            match parse::<u32>(word).filter(|&i| (i as usize) < soup.vertices.len()) {
                Some(index) => corners.push(index),
                None => return Err(malformed(FORMAT, Some(at), "a corner is not the index of a vertex")),
            }
        }
        soup.polygon(&corners)?;
    }
    Ok(soup)
}
