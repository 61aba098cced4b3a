//! Tensors from storages: a tensor is an offset, a shape and strides into a row of numbers that others may share.
//!
//! What a tensor reaches is checked against its storage, and what all tensors take together against [`MAX_ELEMENTS`], before
//! a storage is unpacked. Storages are unpacked one after another, so that no two are held at once.

use super::globals::Kind;
use super::pickle::Loaded;
use super::{FORMAT, MAX_ELEMENTS, MAX_STORAGE_BYTES};
use crate::field::FieldError;
use crate::field::network::tensors::{Tensor, Tensors, bfloat, half};
use std::borrow::Cow;

/// Numbers that lie outside the pickle.
#[derive(Debug)]
pub(super) struct Storage<'a> {
    /// Its name in the container.
    pub key: &'a str,
    /// How its numbers are written.
    pub kind: Kind,
    /// How many they are.
    pub count: usize,
}

/// A part of a storage: all of it but in files of before 2018.
#[derive(Debug)]
pub(super) struct View {
    /// Number of the storage.
    pub storage: usize,
    /// Numbers before the part.
    pub offset: usize,
    /// Numbers in the part, which ends within the storage.
    pub count: usize,
}

/// A tensor as the pickle describes it.
#[derive(Debug)]
pub(super) struct Record {
    /// Number of the view that holds its numbers.
    pub view: usize,
    /// Place of its first number in the view.
    pub offset: usize,
    /// Length of every axis.
    pub shape: Vec<usize>,
    /// Numbers from one entry of an axis to the next, for every axis.
    pub strides: Vec<usize>,
    /// Where in the file the pickle makes it.
    pub at: usize,
}

impl Record {
    /// Number of entries, or `None` where they are more than can be counted. The axes beside one of length 0 must be
    /// countable too, so that no product of a shape overflows for those who take it later.
    fn count(&self) -> Option<usize> {
        let full = self.shape.iter().try_fold(1usize, |count, &axis| count.checked_mul(axis.max(1)))?;
        Some(if self.shape.contains(&0) { 0 } else { full })
    }

    /// Numbers from the view's first to the tensor's last, or `None` where they are more than can be counted.
    fn reach(&self) -> Option<usize> {
        let axes = self.shape.iter().zip(&self.strides);
        let last = axes.map(|(&axis, &stride)| axis.saturating_sub(1).checked_mul(stride));
        last.chain([Some(self.offset), Some(1)]).try_fold(0usize, |sum, part| sum.checked_add(part?))
    }
}

/// Bytes of a storage, checked against the limit.
pub(super) fn storage_bytes(storage: &Storage<'_>) -> Result<usize, FieldError> {
    let size = storage.count.saturating_mul(storage.kind.size());
    if size > MAX_STORAGE_BYTES {
        let (found, limit) = (size as u64, MAX_STORAGE_BYTES as u64);
        return Err(FieldError::Limit { what: "bytes of a storage of a checkpoint", found, limit });
    }
    Ok(size)
}

/// Reads the named tensors; `fetch` gives the bytes of a storage, as many as [`storage_bytes`] says.
pub(super) fn tensors<'b>(
    loaded: &Loaded<'_>,
    names: Vec<(String, usize)>,
    mut fetch: impl FnMut(&Storage<'_>) -> Result<Cow<'b, [u8]>, FieldError>,
) -> Result<Tensors, FieldError> {
    let mut total = 0usize;
    let mut planned = Vec::with_capacity(names.len());
    for (name, tensor) in names {
        let record = &loaded.tensors[tensor];
        let view = &loaded.views[record.view];
        let count = record.count();
        if count != Some(0) && record.reach().is_none_or(|reach| reach > view.count) {
            let (shape, held) = (&record.shape, view.count);
            let detail =
                format!("the tensor {name:?} of shape {shape:?} reaches past the {held} numbers of its storage");
            return Err(FieldError::Malformed { format: FORMAT, at: Some(record.at as u64), detail });
        }
        total = count.and_then(|count| total.checked_add(count)).unwrap_or(usize::MAX);
        if total > MAX_ELEMENTS {
            let (found, limit) = (total as u64, MAX_ELEMENTS as u64);
            return Err(FieldError::Limit { what: "numbers of a checkpoint", found, limit });
        }
        planned.push((view.storage, name, record, count.unwrap_or(0)));
    }
    planned.sort_by_key(|(storage, ..)| *storage);
    let mut made = Tensors::new();
    let mut held: Option<(usize, Cow<'b, [u8]>)> = None;
    for (index, name, record, count) in planned {
        let mut tensor = Tensor { shape: record.shape.clone(), values: Vec::new() };
        if count > 0 {
            let storage = &loaded.storages[index];
            if held.as_ref().is_none_or(|(last, _)| *last != index) {
                drop(held.take());
                held = Some((index, fetch(storage)?));
            }
            let bytes = held.as_ref().map_or(&[][..], |(_, bytes)| bytes);
            let first = loaded.views[record.view].offset + record.offset;
            tensor.values = gather(storage.kind, bytes, first, record, count);
        }
        made.insert(name, tensor);
    }
    Ok(made)
}

/// The numbers of a tensor in row-major order. Its reach lies in `bytes`.
fn gather(kind: Kind, bytes: &[u8], first: usize, record: &Record, count: usize) -> Vec<f32> {
    let mut values = Vec::with_capacity(count);
    let (length, stride) = match (record.shape.last(), record.strides.last()) {
        (Some(&length), Some(&stride)) => (length, stride),
        _ => (1, 1),
    };
    let outer = record.shape.len().saturating_sub(1);
    let mut index = [0usize; super::pickle::MAX_AXES];
    let mut row = first;
    while values.len() < count {
        decode(kind, bytes, (0..length).map(|i| row + i * stride), &mut values);
        for axis in (0..outer).rev() {
            index[axis] += 1;
            row += record.strides[axis];
            if index[axis] < record.shape[axis] {
                break;
            }
            row -= record.strides[axis] * record.shape[axis];
            index[axis] = 0;
        }
    }
    values
}

/// Appends the numbers at the given places as the nearest `f32`.
fn decode(kind: Kind, bytes: &[u8], places: impl Iterator<Item = usize>, values: &mut Vec<f32>) {
    fn all<const N: usize>(
        bytes: &[u8],
        places: impl Iterator<Item = usize>,
        values: &mut Vec<f32>,
        number: impl Fn([u8; N]) -> f32,
    ) {
        let (numbers, _) = bytes.as_chunks::<N>();
        values.extend(places.map(|place| number(numbers[place])));
    }
    match kind {
        Kind::F16 => all(bytes, places, values, |b| half(u16::from_le_bytes(b))),
        Kind::Bf16 => all(bytes, places, values, |b| bfloat(u16::from_le_bytes(b))),
        Kind::F32 => all(bytes, places, values, f32::from_le_bytes),
        Kind::F64 => all(bytes, places, values, |b| f64::from_le_bytes(b) as f32),
        Kind::I8 => all(bytes, places, values, |b| f32::from(i8::from_le_bytes(b))),
        Kind::U8 => all(bytes, places, values, |[b]| f32::from(b)),
        Kind::I16 => all(bytes, places, values, |b| f32::from(i16::from_le_bytes(b))),
        Kind::I32 => all(bytes, places, values, |b| i32::from_le_bytes(b) as f32),
        Kind::I64 => all(bytes, places, values, |b| i64::from_le_bytes(b) as f32),
        Kind::Bool => all(bytes, places, values, |[b]| f32::from(u8::from(b != 0))),
    }
}
