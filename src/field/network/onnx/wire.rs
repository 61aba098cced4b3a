//! The wire format of protocol buffers: fields of a message one after the other, without copying and without recursion.
//!
//! <https://protobuf.dev/programming-guides/encoding/>. A nested message is a slice of the one around it, so lengths can only
//! shrink, and whoever reads it decides how deep to go.

use super::fault;
use crate::field::FieldError;

/// The fields of a message that are still to be read.
#[derive(Clone, Copy, Debug)]
pub(super) struct Message<'a> {
    rest: &'a [u8],
    /// Offset of `rest` in the file.
    at: u64,
}

/// A field of a message.
#[derive(Clone, Copy, Debug)]
pub(super) struct Field<'a> {
    /// The number that stands for its name.
    pub number: u64,
    /// Offset of its tag in the file.
    pub at: u64,
    wire: Wire<'a>,
}

#[derive(Clone, Copy, Debug)]
enum Wire<'a> {
    Varint(u64),
    Fixed64([u8; 8]),
    Bytes(Message<'a>),
    Fixed32([u8; 4]),
}

impl<'a> Message<'a> {
    /// The message that a whole file is.
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes, at: 0 }
    }

    /// The bytes that are still to be read.
    pub(super) fn bytes(self) -> &'a [u8] {
        self.rest
    }

    /// Offset in the file of what is still to be read.
    pub(super) fn offset(self) -> u64 {
        self.at
    }

    /// The next field, or `None` at the message's end.
    pub(super) fn next(&mut self) -> Result<Option<Field<'a>>, FieldError> {
        if self.rest.is_empty() {
            return Ok(None);
        }
        let at = self.at;
        let tag = self.varint()?;
        let wire = match tag & 7 {
            0 => Wire::Varint(self.varint()?),
            1 => Wire::Fixed64(self.array()?),
            2 => {
                let length = self.varint()?;
                let start = self.at;
                let held = self.rest.len();
                let Some((bytes, rest)) =
                    usize::try_from(length).ok().and_then(|length| self.rest.split_at_checked(length))
                else {
                    return Err(fault(Some(at), format!("a field of {length} bytes where {held} are left")));
                };
                (self.rest, self.at) = (rest, self.at + length);
                Wire::Bytes(Self { rest: bytes, at: start })
            }
            5 => Wire::Fixed32(self.array()?),
            other => return Err(fault(Some(at), format!("wire type {other}, which no field of a model has"))),
        };
        if tag >> 3 == 0 || tag >> 32 != 0 {
            return Err(fault(Some(at), format!("field number {}", tag >> 3)));
        }
        Ok(Some(Field { number: tag >> 3, at, wire }))
    }

    /// A number in groups of seven bits, the lowest first.
    pub(super) fn varint(&mut self) -> Result<u64, FieldError> {
        let mut value = 0u64;
        for (i, &byte) in self.rest.iter().enumerate().take(10) {
            let bits = u64::from(byte & 0x7f);
            if i == 9 && bits > 1 {
                break;
            }
            value |= bits << (7 * i);
            if byte & 0x80 == 0 {
                (self.rest, self.at) = (&self.rest[i + 1..], self.at + i as u64 + 1);
                return Ok(value);
            }
        }
        let what = if self.rest.len() < 10 { "a number that is cut off" } else { "a number of more than 64 bits" };
        Err(fault(Some(self.at), what.to_owned()))
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], FieldError> {
        let Some((array, rest)) = self.rest.split_first_chunk::<N>() else {
            return Err(fault(Some(self.at), format!("{} bytes where {N} are expected", self.rest.len())));
        };
        (self.rest, self.at) = (rest, self.at + N as u64);
        Ok(*array)
    }
}

impl<'a> Field<'a> {
    fn wrong<T>(&self, expected: &str) -> Result<T, FieldError> {
        Err(fault(Some(self.at), format!("field {} is not {expected}", self.number)))
    }

    /// A nested message, or bytes.
    pub(super) fn message(&self) -> Result<Message<'a>, FieldError> {
        match self.wire {
            Wire::Bytes(message) => Ok(message),
            _ => self.wrong("a message or bytes"),
        }
    }

    /// A string.
    pub(super) fn text(&self) -> Result<&'a str, FieldError> {
        str::from_utf8(self.message()?.bytes()).or_else(|_| self.wrong("text in UTF-8"))
    }

    /// A signed number.
    pub(super) fn int(&self) -> Result<i64, FieldError> {
        match self.wire {
            Wire::Varint(value) => Ok(value.cast_signed()),
            _ => self.wrong("a whole number"),
        }
    }

    /// A number of single precision.
    pub(super) fn float(&self) -> Result<f32, FieldError> {
        match self.wire {
            Wire::Fixed32(bytes) => Ok(f32::from_le_bytes(bytes)),
            _ => self.wrong("a number of single precision"),
        }
    }

    /// Appends the whole numbers of a repeated field: one, or many that are packed.
    pub(super) fn ints(&self, list: &mut Vec<i64>, most: usize) -> Result<(), FieldError> {
        match self.wire {
            Wire::Varint(value) => list.push(value.cast_signed()),
            Wire::Bytes(mut packed) => {
                while !packed.rest.is_empty() && list.len() <= most {
                    list.push(packed.varint()?.cast_signed());
                }
            }
            _ => return self.wrong("a list of whole numbers"),
        }
        if list.len() > most {
            return self.wrong(&format!("a list of at most {most} numbers"));
        }
        Ok(())
    }

    /// Appends the numbers of N bytes of a repeated field: one, or many that are packed.
    pub(super) fn fixed<const N: usize>(&self, list: &mut Vec<[u8; N]>, most: usize) -> Result<(), FieldError> {
        let bytes = match &self.wire {
            Wire::Fixed32(bytes) => &bytes[..],
            Wire::Fixed64(bytes) => &bytes[..],
            Wire::Bytes(packed) => packed.rest,
            Wire::Varint(_) => return self.wrong("a list of numbers of a fixed size"),
        };
        let (numbers, rest) = bytes.as_chunks::<N>();
        if !rest.is_empty() {
            return self.wrong(&format!("a list of numbers of {N} bytes"));
        }
        if numbers.len() > most - list.len().min(most) {
            return self.wrong(&format!("a list of at most {most} numbers"));
        }
        list.extend_from_slice(numbers);
        Ok(())
    }
}
