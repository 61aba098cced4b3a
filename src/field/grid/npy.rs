//! The `.npy` format: a header that says type, order and shape, and the numbers behind it.
//!
//! Read are `f4` and `f8` of both byte orders. The header is a Python literal; only the literals that NumPy writes are
//! understood, everything else is refused at its byte.

use crate::field::FieldError;

const FORMAT: &str = "npy";
/// NumPy's headers have 118 bytes; its own reader refuses more than this.
const MAX_HEADER: usize = 10_000;
/// Most axes of an array.
const MAX_AXES: usize = 8;

/// What an array begins with.
const MAGIC: &[u8] = b"\x93NUMPY";

/// Whether the bytes begin as an array does.
pub(in crate::field) fn claims(bytes: &[u8]) -> bool {
    bytes.starts_with(MAGIC)
}

/// What a header says, checked against the length of the bytes.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::field) struct Header {
    /// Bytes of a number: 4 or 8.
    pub width: usize,
    pub big_endian: bool,
    /// Whether the first axis varies fastest.
    pub fortran: bool,
    pub shape: Vec<usize>,
    /// Offset of the first number.
    pub body: usize,
}

impl Header {
    /// Number of numbers.
    pub fn count(&self) -> usize {
        self.shape.iter().product()
    }

    /// Number `i` in the order of the file. `bytes` are those that the header was read from.
    pub fn number(&self, bytes: &[u8], i: usize) -> f64 {
        let at = self.body + i * self.width;
        if self.width == 4 {
            let mut raw = [0; 4];
            raw.copy_from_slice(&bytes[at..at + 4]);
            f64::from(if self.big_endian { f32::from_be_bytes(raw) } else { f32::from_le_bytes(raw) })
        } else {
            let mut raw = [0; 8];
            raw.copy_from_slice(&bytes[at..at + 8]);
            if self.big_endian { f64::from_be_bytes(raw) } else { f64::from_le_bytes(raw) }
        }
    }
}

/// Reads the header; all numbers it promises are there, and there are at most `max_count` of them.
pub(in crate::field) fn header(bytes: &[u8], max_count: usize) -> Result<Header, FieldError> {
    let fault = |at: usize, detail: &str| FieldError::Malformed {
        format: FORMAT,
        at: Some(at as u64),
        detail: detail.to_owned(),
    };
    if !claims(bytes) {
        return Err(fault(0, "the array does not begin with \\x93NUMPY"));
    }
    let (length, start) = match (bytes.get(6), bytes.get(8..)) {
        (Some(1), Some(&[a, b, ..])) => (usize::from(u16::from_le_bytes([a, b])), 10),
        (Some(2 | 3), Some(&[a, b, c, d, ..])) => (u32::from_le_bytes([a, b, c, d]) as usize, 12),
        (Some(1..=3) | None, _) => return Err(fault(bytes.len(), "the file ends inside the header")),
        (Some(_), _) => return Err(fault(6, "unknown version of the format")),
    };
    if length > MAX_HEADER {
        let (found, limit) = (length as u64, MAX_HEADER as u64);
        return Err(FieldError::Limit { what: "bytes of an npy header", found, limit });
    }
    let text = bytes.get(start..start + length).ok_or_else(|| fault(bytes.len(), "the file ends inside the header"))?;
    let mut literal = Literal { text, at: 0 };
    let parsed = literal.dictionary().map_err(|detail| fault(start + literal.at, detail))?;
    let (width, big_endian) = match parsed.descr.as_slice() {
        b"<f4" | b"=f4" => (4, false),
        b"<f8" | b"=f8" => (8, false),
        b">f4" => (4, true),
        b">f8" => (8, true),
        other => {
            let detail = format!("an npy array of type {:?}, not f4 or f8", String::from_utf8_lossy(other));
            return Err(FieldError::Unsupported { detail });
        }
    };
    let body = start + length;
    let count = parsed.shape.iter().try_fold(1usize, |n, &axis| n.checked_mul(axis)).unwrap_or(usize::MAX);
    if count > max_count {
        let (found, limit) = (count as u64, max_count as u64);
        return Err(FieldError::Limit { what: "numbers of an npy array", found, limit });
    }
    let needed = count.saturating_mul(width);
    if bytes.len() - body < needed {
        let detail = format!("the shape asks for {needed} bytes of numbers and {} follow", bytes.len() - body);
        return Err(fault(bytes.len(), &detail));
    }
    Ok(Header { width, big_endian, fortran: parsed.fortran, shape: parsed.shape, body })
}

/// The rows of an array of shape `[rows, columns]` (or `[rows, 1, columns]`, which some code saves), in single precision; `None` when the
/// bytes are no array at all.
///
/// # Errors
/// When the bytes are malformed, hold more than `max_count` numbers, or have another shape or type.
pub fn rows(bytes: &[u8], max_count: usize) -> Option<Result<Vec<Vec<f32>>, FieldError>> {
    claims(bytes).then(|| {
        let header = header(bytes, max_count)?;
        let (rows, columns) = match header.shape[..] {
            [rows, columns] | [rows, 1, columns] if columns > 0 => (rows, columns),
            _ => {
                let detail = format!("an array of shape {:?}, where rows of numbers are expected", header.shape);
                return Err(FieldError::Unsupported { detail });
            }
        };
        let at = |row: usize, column: usize| if header.fortran { column * rows + row } else { row * columns + column };
        let number = |row, column| header.number(bytes, at(row, column)) as f32;
        Ok((0..rows).map(|row| (0..columns).map(|column| number(row, column)).collect()).collect())
    })
}

struct Parsed {
    descr: Vec<u8>,
    fortran: bool,
    shape: Vec<usize>,
}

/// A reader of `{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }`.
struct Literal<'a> {
    text: &'a [u8],
    at: usize,
}

impl Literal<'_> {
    fn dictionary(&mut self) -> Result<Parsed, &'static str> {
        let (mut descr, mut fortran, mut shape) = (None, None, None);
        self.expect(b'{')?;
        while !self.accept(b'}') {
            let key = self.string()?;
            self.expect(b':')?;
            match key.as_slice() {
                b"descr" => descr = Some(self.string()?),
                b"fortran_order" => fortran = Some(self.boolean()?),
                b"shape" => shape = Some(self.tuple()?),
                _ => return Err("unknown key in the header"),
            }
            if !self.accept(b',') {
                self.expect(b'}')?;
                break;
            }
        }
        Ok(Parsed {
            descr: descr.ok_or("the header has no descr")?,
            fortran: fortran.ok_or("the header has no fortran_order")?,
            shape: shape.ok_or("the header has no shape")?,
        })
    }

    fn peek(&mut self) -> Option<u8> {
        while self.text.get(self.at).is_some_and(u8::is_ascii_whitespace) {
            self.at += 1;
        }
        self.text.get(self.at).copied()
    }

    fn accept(&mut self, byte: u8) -> bool {
        let found = self.peek() == Some(byte);
        self.at += usize::from(found);
        found
    }

    fn expect(&mut self, byte: u8) -> Result<(), &'static str> {
        if self.accept(byte) { Ok(()) } else { Err("the header is not the literal that was expected here") }
    }

    fn string(&mut self) -> Result<Vec<u8>, &'static str> {
        let quote = self.peek().filter(|q| matches!(q, b'\'' | b'"')).ok_or("a string was expected here")?;
        let rest = &self.text[self.at + 1..];
        let end = rest.iter().position(|&b| b == quote).ok_or("a string does not end")?;
        self.at += end + 2;
        Ok(rest[..end].to_vec())
    }

    fn boolean(&mut self) -> Result<bool, &'static str> {
        self.peek();
        for (word, value) in [(b"True".as_slice(), true), (b"False", false)] {
            if self.text[self.at..].starts_with(word) {
                self.at += word.len();
                return Ok(value);
            }
        }
        Err("True or False was expected here")
    }

    fn tuple(&mut self) -> Result<Vec<usize>, &'static str> {
        self.expect(b'(')?;
        let mut shape = Vec::new();
        while !self.accept(b')') {
            self.peek();
            let digits = self.text[self.at..].iter().take_while(|b| b.is_ascii_digit()).count();
            let number = std::str::from_utf8(&self.text[self.at..self.at + digits]).ok().and_then(|d| d.parse().ok());
            shape.push(number.ok_or("a whole number was expected here")?);
            if shape.len() > MAX_AXES {
                return Err("the array has more than eight axes");
            }
            self.at += digits;
            if !self.accept(b',') {
                self.expect(b')')?;
                break;
            }
        }
        Ok(shape)
    }
}
