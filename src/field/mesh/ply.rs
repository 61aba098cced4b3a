//! Stanford PLY: text and binary of both byte orders, any scalar types, polygons of any number of corners.
//!
//! Elements other than `vertex` and `face`, and properties other than `x y z` and `vertex_indices` (or `vertex_index`),
//! are walked over.

use super::text::{Words, lines, parse};
use super::{FieldError, MAX_CORNERS, MAX_TRIANGLES, MAX_VERTICES, Soup, limit, malformed};

const FORMAT: &str = "ply";
/// A header is a few hundred bytes; whoever needs more than this is not describing a mesh.
const MAX_HEADER: usize = 64 * 1024;
const MAX_PROPERTIES: usize = 256;

#[derive(Clone, Copy, PartialEq)]
enum Encoding {
    Text,
    Little,
    Big,
}

#[derive(Clone, Copy, PartialEq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn named(name: &[u8]) -> Option<Self> {
        Some(match name {
            b"char" | b"int8" => Self::I8,
            b"uchar" | b"uint8" => Self::U8,
            b"short" | b"int16" => Self::I16,
            b"ushort" | b"uint16" => Self::U16,
            b"int" | b"int32" => Self::I32,
            b"uint" | b"uint32" => Self::U32,
            b"float" | b"float32" => Self::F32,
            b"double" | b"float64" => Self::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }
}

struct Property {
    name: Vec<u8>,
    /// Type of the list's length, for a list.
    length: Option<Scalar>,
    value: Scalar,
}

struct Element {
    name: Vec<u8>,
    count: usize,
    properties: Vec<Property>,
}

struct Header {
    encoding: Encoding,
    elements: Vec<Element>,
    /// First byte behind the header.
    body: usize,
}

pub(super) fn read(bytes: &[u8]) -> Result<Soup, FieldError> {
    let header = header(bytes)?;
    let mut soup = Soup::new(FORMAT);
    let mut body = Body {
        bytes,
        at: header.body,
        words: Words::new(FORMAT, bytes, header.body, bytes.len()),
        encoding: header.encoding,
    };
    let mut corners = Vec::new();
    for element in &header.elements {
        match element.name.as_slice() {
            b"vertex" => vertices(element, &mut body, &mut soup)?,
            b"face" => faces(element, &mut body, &mut soup, &mut corners)?,
            b"tristrips" => {
                return Err(FieldError::Unsupported { detail: "the PLY element tristrips".to_owned() });
            }
            _ => {
                for _ in 0..element.count {
                    for property in &element.properties {
                        body.skip(property)?;
                    }
                }
            }
        }
    }
    Ok(soup)
}

fn header(bytes: &[u8]) -> Result<Header, FieldError> {
    let fault = |at: usize, detail: String| malformed(FORMAT, Some(at), detail);
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    let scanned = &bytes[..bytes.len().min(MAX_HEADER)];
    for (at, line) in lines(scanned).skip(1) {
        let mut words = Words::new(FORMAT, bytes, at, at + line.len());
        let Some((_, keyword)) = words.next() else { continue };
        match keyword {
            b"comment" | b"obj_info" => {}
            b"format" => {
                encoding = Some(match words.required("the encoding")?.1 {
                    b"ascii" => Encoding::Text,
                    b"binary_little_endian" => Encoding::Little,
                    b"binary_big_endian" => Encoding::Big,
                    other => return Err(fault(at, format!("unknown encoding {:?}", String::from_utf8_lossy(other)))),
                });
            }
            b"element" => {
                let name = words.required("the element's name")?.1.to_vec();
                let count = words.count("the number of elements")?;
                elements.push(Element { name, count, properties: Vec::new() });
            }
            b"property" => {
                let element = elements.last_mut().ok_or_else(|| fault(at, "a property before any element".into()))?;
                if element.properties.len() == MAX_PROPERTIES {
                    return Err(limit("properties of a PLY element", MAX_PROPERTIES + 1, MAX_PROPERTIES));
                }
                let scalar = |word: &[u8]| {
                    Scalar::named(word)
                        .ok_or_else(|| fault(at, format!("unknown type {:?}", String::from_utf8_lossy(word))))
                };
                let first = words.required("the property's type")?.1;
                let (length, value) = if first == b"list" {
                    let length = scalar(words.required("the list's length type")?.1)?;
                    (Some(length), scalar(words.required("the list's type")?.1)?)
                } else {
                    (None, scalar(first)?)
                };
                let name = words.required("the property's name")?.1.to_vec();
                element.properties.push(Property { name, length, value });
            }
            b"end_header" => {
                let encoding = encoding.ok_or_else(|| fault(at, "the header has no format line".into()))?;
                if elements.iter().any(|e| e.properties.is_empty() && e.count > 0) {
                    return Err(fault(at, "an element has no property".into()));
                }
                return Ok(Header { encoding, elements, body: bytes.len().min(at + bytes_of_line(bytes, at)) });
            }
            other => return Err(fault(at, format!("unknown header line {:?}", String::from_utf8_lossy(other)))),
        }
    }
    Err(fault(scanned.len(), "the header does not end".into()))
}

/// Length of the line that begins at `at`, with its line end.
fn bytes_of_line(bytes: &[u8], at: usize) -> usize {
    bytes[at..].iter().position(|&b| b == b'\n').map_or(bytes.len() - at, |n| n + 1)
}

fn vertices(element: &Element, body: &mut Body<'_>, soup: &mut Soup) -> Result<(), FieldError> {
    if element.count > MAX_VERTICES {
        return Err(limit("vertices of a mesh", element.count, MAX_VERTICES));
    }
    let axis = |property: &Property| match property.name.as_slice() {
        b"x" => Some(0),
        b"y" => Some(1),
        b"z" => Some(2),
        _ => None,
    };
    for name in [b"x", b"y", b"z"] {
        if !element.properties.iter().any(|p| p.name == name && p.length.is_none()) {
            let detail = format!("the vertices have no {}", String::from_utf8_lossy(name));
            return Err(malformed(FORMAT, None, detail));
        }
    }
    for _ in 0..element.count {
        let (mut position, at) = ([0.0; 3], body.position());
        for property in &element.properties {
            match axis(property) {
                Some(axis) if property.length.is_none() => position[axis] = body.scalar(property.value)?,
                _ => body.skip(property)?,
            }
        }
        soup.vertex(position, at)?;
    }
    Ok(())
}

fn faces(element: &Element, body: &mut Body<'_>, soup: &mut Soup, corners: &mut Vec<u32>) -> Result<(), FieldError> {
    if element.count > MAX_TRIANGLES {
        return Err(limit("triangles of a mesh", element.count, MAX_TRIANGLES));
    }
    for _ in 0..element.count {
        for property in &element.properties {
            match (property.name.as_slice(), property.length) {
                (b"vertex_indices" | b"vertex_index", Some(length)) => {
                    let n = body.length(length)?;
                    if n > MAX_CORNERS {
                        return Err(limit("corners of a polygon", n, MAX_CORNERS));
                    }
                    corners.clear();
                    for _ in 0..n {
                        let at = body.position();
                        let index = body.scalar(property.value)?;
                        if !(index >= 0.0 && index < soup.vertices.len() as f64 && index.fract() == 0.0) {
                            return Err(malformed(FORMAT, Some(at), format!("no vertex has the index {index}")));
                        }
                        corners.push(index as u32);
                    }
                    soup.polygon(corners)?;
                }
                _ => body.skip(property)?,
            }
        }
    }
    Ok(())
}

/// The elements' bytes, read front to back.
struct Body<'a> {
    bytes: &'a [u8],
    at: usize,
    words: Words<'a>,
    encoding: Encoding,
}

impl Body<'_> {
    fn position(&self) -> usize {
        if self.encoding == Encoding::Text { self.words.position() } else { self.at }
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], FieldError> {
        let chunk = self.bytes[self.at..].first_chunk::<N>();
        let mut chunk = *chunk.ok_or_else(|| malformed(FORMAT, Some(self.at), "the file ends inside an element"))?;
        self.at += N;
        if self.encoding == Encoding::Big {
            chunk.reverse();
        }
        Ok(chunk)
    }

    fn scalar(&mut self, kind: Scalar) -> Result<f64, FieldError> {
        if self.encoding == Encoding::Text {
            let (at, word) = self.words.required("an element's value")?;
            return parse(word).ok_or_else(|| malformed(FORMAT, Some(at), "an element's value is not a number"));
        }
        Ok(match kind {
            Scalar::I8 => f64::from(i8::from_le_bytes(self.take()?)),
            Scalar::U8 => f64::from(u8::from_le_bytes(self.take()?)),
            Scalar::I16 => f64::from(i16::from_le_bytes(self.take()?)),
            Scalar::U16 => f64::from(u16::from_le_bytes(self.take()?)),
            Scalar::I32 => f64::from(i32::from_le_bytes(self.take()?)),
            Scalar::U32 => f64::from(u32::from_le_bytes(self.take()?)),
            Scalar::F32 => f64::from(f32::from_le_bytes(self.take()?)),
            Scalar::F64 => f64::from_le_bytes(self.take()?),
        })
    }

    fn length(&mut self, kind: Scalar) -> Result<usize, FieldError> {
        let (at, length) = (self.position(), self.scalar(kind)?);
        // a list cannot have more entries than the file has bytes
        if length >= 0.0 && length <= self.bytes.len() as f64 && length.fract() == 0.0 {
            Ok(length as usize)
        } else {
            Err(malformed(FORMAT, Some(at), format!("a list's length is {length}")))
        }
    }

    fn skip(&mut self, property: &Property) -> Result<(), FieldError> {
        let n = property.length.map_or(Ok(1), |length| self.length(length))?;
        if self.encoding == Encoding::Text {
            for _ in 0..n {
                self.words.required("an element's value")?;
            }
            return Ok(());
        }
        let end = self.at + n * property.value.size();
        if end > self.bytes.len() {
            return Err(malformed(FORMAT, Some(self.bytes.len()), "the file ends inside an element"));
        }
        self.at = end;
        Ok(())
    }
}
