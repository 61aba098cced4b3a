//! What reading a file may cost, in proportion to its size.

use crate::field::FieldError;

/// Numbers that may be made for every byte of the file: a weight of two bytes passes through at most some ten values on its way
/// (decoded, cast, transposed, normalized, multiplied into forms, written as a layer).
const NUMBERS_A_BYTE: u64 = 8;
/// Multiplications for every byte of the file: one product of two hidden layers without an activation between them fits.
const WORK_A_BYTE: u64 = 64;
/// What a small file may use beyond its proportion.
const NUMBERS_AT_LEAST: u64 = 1 << 22;
const WORK_AT_LEAST: u64 = 1 << 24;

/// Counts down what is left.
#[derive(Debug)]
pub(super) struct Budget {
    numbers: u64,
    work: u64,
    limits: [u64; 2],
}

impl Budget {
    pub(super) fn new(bytes: usize) -> Self {
        let numbers = NUMBERS_AT_LEAST + NUMBERS_A_BYTE * bytes as u64;
        let work = WORK_AT_LEAST + WORK_A_BYTE * bytes as u64;
        Self { numbers, work, limits: [numbers, work] }
    }

    /// Takes so many numbers that are about to be made.
    pub(super) fn numbers(&mut self, count: usize) -> Result<(), FieldError> {
        let what = "numbers that an ONNX model of this size may be worked out to";
        take(&mut self.numbers, self.limits[0], count, what)
    }

    /// Whether so many multiplications would still be within the budget.
    pub(super) fn affords(&self, work: usize) -> bool {
        work as u64 <= self.work
    }

    /// Takes so many multiplications that are about to be done.
    pub(super) fn work(&mut self, count: usize) -> Result<(), FieldError> {
        take(&mut self.work, self.limits[1], count, "multiplications that an ONNX model of this size may take")
    }
}

fn take(left: &mut u64, limit: u64, count: usize, what: &'static str) -> Result<(), FieldError> {
    match left.checked_sub(count as u64) {
        Some(rest) => *left = rest,
        None => return Err(FieldError::Limit { what, found: (limit - *left).saturating_add(count as u64), limit }),
    }
    Ok(())
}
