//! Words of a text file with the byte each begins at, for the readers of text formats.

use super::{FieldError, malformed};

/// Splits a byte slice at ASCII white space; remembers where each word begins.
#[derive(Clone)]
pub(super) struct Words<'a> {
    bytes: &'a [u8],
    at: usize,
    format: &'static str,
}

impl<'a> Words<'a> {
    /// The words of `bytes[from..to]`; offsets count from the start of `bytes`.
    pub fn new(format: &'static str, bytes: &'a [u8], from: usize, to: usize) -> Self {
        Self { bytes: &bytes[..to.min(bytes.len())], at: from, format }
    }

    /// The next word and the byte it begins at.
    pub fn next(&mut self) -> Option<(usize, &'a [u8])> {
        while self.bytes.get(self.at).is_some_and(u8::is_ascii_whitespace) {
            self.at += 1;
        }
        let start = self.at;
        while self.bytes.get(self.at).is_some_and(|b| !b.is_ascii_whitespace()) {
            self.at += 1;
        }
        (self.at > start).then(|| (start, &self.bytes[start..self.at]))
    }

    /// The next word as a number; `what` says in the error what was expected.
    pub fn number(&mut self, what: &str) -> Result<f64, FieldError> {
        let (at, word) = self.required(what)?;
        parse(word).ok_or_else(|| malformed(self.format, Some(at), format!("{what} is not a number")))
    }

    /// The next word as a whole number that is not negative.
    pub fn count(&mut self, what: &str) -> Result<usize, FieldError> {
        let (at, word) = self.required(what)?;
        parse(word).ok_or_else(|| malformed(self.format, Some(at), format!("{what} is not a whole number")))
    }

    /// The next word; an error when there is none.
    pub fn required(&mut self, what: &str) -> Result<(usize, &'a [u8]), FieldError> {
        let end = self.bytes.len();
        self.next().ok_or_else(|| malformed(self.format, Some(end), format!("the text ends before {what}")))
    }

    /// Goes to the end of the line.
    pub fn skip_line(&mut self) {
        while self.bytes.get(self.at).is_some_and(|&b| b != b'\n') {
            self.at += 1;
        }
    }

    /// Where the next word is looked for.
    pub fn position(&self) -> usize {
        self.at
    }
}

/// A word as a value of its type.
pub(super) fn parse<T: std::str::FromStr>(word: &[u8]) -> Option<T> {
    std::str::from_utf8(word).ok()?.parse().ok()
}

/// The lines of a file, each with the byte it begins at, without line ends.
pub(super) fn lines(bytes: &[u8]) -> impl Iterator<Item = (usize, &[u8])> {
    let mut at = 0;
    bytes.split(|&b| b == b'\n').map(move |line| {
        let start = at;
        at += line.len() + 1;
        (start, line.strip_suffix(b"\r").unwrap_or(line))
    })
}
