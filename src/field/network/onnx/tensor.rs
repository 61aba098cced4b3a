//! Numbers of a tensor message, whatever their type and whichever of its fields holds them.

use super::model::RawTensor;
use super::wire::Message;
use super::{fault, quoted};
use crate::field::FieldError;
use crate::field::network::MAX_PARAMETERS;
use crate::field::network::tensors::{bfloat, half};

/// A constant, row-major. Whole numbers are exact up to 2^53, far beyond any index that is of use.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Tensor {
    /// Lengths of the axes.
    pub shape: Vec<usize>,
    /// Whether the numbers are whole numbers or truth values.
    pub integer: bool,
    /// The numbers. Those of a file are finite.
    pub numbers: Vec<f64>,
}

/// How the numbers of an element type are stored.
struct Kind {
    /// Bytes of a number in `raw_data`.
    size: usize,
    integer: bool,
    /// Field of the typed list.
    list: u64,
    from_raw: fn(&[u8]) -> f64,
}

fn kind(number: i64) -> Option<Kind> {
    // chunks have the size that stands beside the function
    let kind = match number {
        1 => Kind { size: 4, integer: false, list: 4, from_raw: |b| f64::from(f32::from_le_bytes(fixed(b))) },
        6 => Kind { size: 4, integer: true, list: 5, from_raw: |b| f64::from(i32::from_le_bytes(fixed(b))) },
        7 => Kind { size: 8, integer: true, list: 7, from_raw: |b| i64::from_le_bytes(fixed(b)) as f64 },
        9 => Kind { size: 1, integer: true, list: 5, from_raw: |b| f64::from(b[0]) },
        10 => Kind { size: 2, integer: false, list: 5, from_raw: |b| half(u16::from_le_bytes(fixed(b))).into() },
        11 => Kind { size: 8, integer: false, list: 10, from_raw: |b| f64::from_le_bytes(fixed(b)) },
        16 => Kind { size: 2, integer: false, list: 5, from_raw: |b| bfloat(u16::from_le_bytes(fixed(b))).into() },
        _ => return None,
    };
    Some(kind)
}

fn fixed<const N: usize>(bytes: &[u8]) -> [u8; N] {
    std::array::from_fn(|i| bytes[i])
}

/// The name of an element type that is not read.
fn name_of(kind: i64) -> &'static str {
    match kind {
        2 => "UINT8",
        3 => "INT8",
        4 => "UINT16",
        5 => "INT16",
        8 => "STRING",
        12 => "UINT32",
        13 => "UINT64",
        14 => "COMPLEX64",
        15 => "COMPLEX128",
        17..=20 => "FLOAT8",
        _ => "of an unknown type",
    }
}

impl RawTensor<'_> {
    /// How many numbers the shape holds.
    pub(super) fn count(&self) -> Result<usize, FieldError> {
        let mut count = 1usize;
        for &length in &self.dims {
            let Ok(length) = usize::try_from(length) else {
                return Err(self.fault(format!("has an axis of length {length}")));
            };
            // a later axis may be empty, so a product that is too large is not yet an answer
            count = count.saturating_mul(length);
        }
        if count > MAX_PARAMETERS {
            return Err(FieldError::Limit {
                what: "numbers of an ONNX tensor",
                found: count as u64,
                limit: MAX_PARAMETERS as u64,
            });
        }
        Ok(count)
    }

    /// Reads the numbers.
    pub(super) fn decode(&self) -> Result<Tensor, FieldError> {
        if self.external {
            let detail = format!("the ONNX tensor {} with its numbers in another file", quoted(self.name));
            return Err(FieldError::Unsupported { detail });
        }
        let Some(kind) = kind(self.kind) else {
            let detail = format!("the ONNX tensor {} of the type {}", quoted(self.name), name_of(self.kind));
            return Err(FieldError::Unsupported { detail });
        };
        let count = self.count()?;
        let (mut raw, mut ints, mut singles, mut doubles) = (None, Vec::new(), Vec::new(), Vec::new());
        let mut message: Message<'_> = self.body;
        while let Some(field) = message.next()? {
            match field.number {
                9 => raw = Some(field.message()?),
                number if number != kind.list => {}
                4 => field.fixed::<4>(&mut singles, count)?,
                10 => field.fixed::<8>(&mut doubles, count)?,
                _ => field.ints(&mut ints, count)?,
            }
        }
        let numbers: Vec<f64> = if let Some(raw) = raw {
            if raw.bytes().len() != count * kind.size {
                let (found, size) = (raw.bytes().len(), kind.size);
                let detail = format!("{} has {found} bytes for {count} numbers of {size}", self.title());
                return Err(fault(Some(raw.offset()), detail));
            }
            raw.bytes().chunks_exact(kind.size).map(kind.from_raw).collect()
        } else {
            match (kind.list, self.kind) {
                (4, _) => singles.into_iter().map(|b| f64::from(f32::from_le_bytes(b))).collect(),
                (10, _) => doubles.into_iter().map(f64::from_le_bytes).collect(),
                (_, 10) => ints.into_iter().map(|i| half(i as u16).into()).collect(),
                (_, 16) => ints.into_iter().map(|i| bfloat(i as u16).into()).collect(),
                _ => ints.into_iter().map(|i| i as f64).collect(),
            }
        };
        if numbers.len() != count {
            return Err(self.fault(format!("holds {} numbers where its shape has {count}", numbers.len())));
        }
        if let Some(at) = numbers.iter().position(|v| !v.is_finite()) {
            return Err(self.fault(format!("is not finite at number {at}")));
        }
        let shape = self.dims.iter().map(|&length| length as usize).collect();
        Ok(Tensor { shape, integer: kind.integer, numbers })
    }

    fn title(&self) -> String {
        format!("tensor {}", quoted(self.name))
    }

    fn fault(&self, detail: String) -> FieldError {
        fault(Some(self.body.offset()), format!("{} {detail}", self.title()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_precision_is_read_exactly() {
        let cases = [
            (0x3c00, 1.0),
            (0xc000, -2.0),
            (0x7bff, 65504.0),
            (0x0001, 5.960_464_5e-8),
            (0x0400, 6.103_515_6e-5),
            (0x3555, 0.333_251_95),
            (0x8000, 0.0),
        ];
        for (bits, expected) in cases {
            assert_eq!(half(bits), expected, "{bits:x}");
        }
        assert!(half(0x7c01).is_nan() && half(0xfc00) == f32::NEG_INFINITY);
        assert_eq!(bfloat(0xc049), -3.140_625);
    }
}
