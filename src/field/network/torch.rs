//! Checkpoints of PyTorch, as `torch.save` writes them: the zip archive of version 1.6 and later and the stream of before.
//!
//! Both hold a pickle that describes an object and the numbers of its tensors beside it. [`read`] gives every tensor that can
//! be reached through dictionaries, lists and tuples, by name; other values are read past. Nothing of the file is run: the
//! pickle is followed by a machine that knows the calls that make tensors, and a global that is not known is refused by name
//! ([`FieldError::Unsupported`]). So a file of `torch.save(network)` is refused, and one of
//! `torch.save(network.state_dict())` is read, an optimizer's state or the options of a command line beside it or not.
//!
//! Sizes, counts and depths are limited before anything is allocated from them. Numbers may be infinite or not a number:
//! who makes a network of them looks. The containers follow `torch/serialization.py`; sparse, quantized and complex tensors
//! and archives of TorchScript are not read.

mod globals;
mod names;
mod pickle;
mod rebuild;
#[cfg(test)]
mod tests;

use super::tensors::Tensors;
use super::{MAX_PARAMETERS, zip};
use crate::field::FieldError;
use pickle::{Loaded, Value};
use rebuild::Storage;
use std::borrow::Cow;
use std::collections::HashMap;

const FORMAT: &str = "PyTorch checkpoint";
/// Most numbers of latent codes that come with a network: 16,384 codes of 1,024.
const MAX_LATENT_NUMBERS: usize = 1 << 24;
/// Most numbers of all tensors of a file (320 MiB).
pub const MAX_ELEMENTS: usize = MAX_PARAMETERS + MAX_LATENT_NUMBERS;
/// Most tensors of a file.
pub const MAX_TENSORS: usize = 4096;
/// Most bytes of one storage: as many as all numbers may take.
const MAX_STORAGE_BYTES: usize = 4 * MAX_ELEMENTS;
/// Most bytes of the pickle in an archive; that of a thousand tensors is some 200 KiB.
const MAX_PICKLE_BYTES: usize = 1 << 26;
/// Most bytes of an entry that is one word.
const MAX_WORD: usize = 16;
/// The pickled number that begins a stream, as the bytes of a long integer.
const MAGIC: [u8; 10] = *b"l\xfc\x9cF\xf9 j\xa8P\x19";
/// The version of the stream, the only one there has been.
const STREAM_VERSION: i64 = 1001;

fn fault(at: Option<usize>, detail: impl Into<String>) -> FieldError {
    FieldError::Malformed { format: FORMAT, at: at.map(|at| at as u64), detail: detail.into() }
}

/// Whether the bytes begin as a stream of version 1.5 or earlier does, in any of the pickle's binary protocols.
pub(in crate::field) fn claims_legacy(bytes: &[u8]) -> bool {
    let Some(([0x80, 2..=5], rest)) = bytes.split_first_chunk::<2>() else { return false };
    // protocols 4 and 5 put the number in a frame, an opcode and a length of eight bytes
    let rest = rest.strip_prefix(&[0x95]).and_then(|framed| framed.get(8..)).unwrap_or(rest);
    rest.strip_prefix(&[0x8a, MAGIC.len() as u8]).is_some_and(|number| number.starts_with(&MAGIC))
}

/// Whether an archive has the entries of a checkpoint.
pub(in crate::field) fn claims_zip(entries: &[zip::Entry]) -> bool {
    root(entries).is_some()
}

/// The folder of the archive, with its slash, in which the pickle is.
fn root(entries: &[zip::Entry]) -> Option<&str> {
    let roots = entries.iter().filter_map(|e| e.name.strip_suffix("data.pkl"));
    roots.filter(|root| root.is_empty() || root.ends_with('/')).min_by_key(|root| root.len())
}

/// Reads the tensors of a checkpoint of either container.
///
/// # Errors
/// [`FieldError::Malformed`] that names the byte, the entry or the tensor; [`FieldError::Unsupported`] for a global that is
/// not known, with its name, and for what the module's documentation says is not read; [`FieldError::Limit`];
/// [`FieldError::Unrecognized`] for bytes of another format.
pub fn read(bytes: &[u8]) -> Result<Tensors, FieldError> {
    if claims_legacy(bytes) {
        return read_stream(bytes);
    }
    if zip::claims(bytes) {
        let entries = zip::entries(bytes)?;
        if claims_zip(&entries) {
            return read_archive(bytes, &entries);
        }
    }
    let detail = "a PyTorch checkpoint is an archive with an entry data.pkl, or begins with PyTorch's magic number";
    Err(FieldError::Unrecognized { detail: detail.to_owned() })
}

fn read_archive(bytes: &[u8], entries: &[zip::Entry]) -> Result<Tensors, FieldError> {
    let root = root(entries).unwrap_or_default();
    let mut inside = HashMap::with_capacity(entries.len());
    for entry in entries {
        if let Some(name) = entry.name.strip_prefix(root)
            && inside.insert(name, entry).is_some()
        {
            return Err(fault(None, format!("the entry {:?} is there twice", entry.name)));
        }
    }
    if inside.contains_key("constants.pkl") {
        let detail = "an archive of TorchScript: save the state_dict of the network instead".to_owned();
        return Err(FieldError::Unsupported { detail });
    }
    if let Some(order) = inside.get("byteorder") {
        let order = if order.size <= MAX_WORD { order.unpack(bytes)? } else { b"of another length".to_vec() };
        if order != b"little" {
            let detail = format!("the byte order {:?} of the checkpoint", String::from_utf8_lossy(&order));
            return Err(FieldError::Unsupported { detail });
        }
    }
    let entry = inside.get("data.pkl").ok_or_else(|| fault(None, "the archive has no entry \"data.pkl\""))?;
    if entry.size > MAX_PICKLE_BYTES {
        let (found, limit) = (entry.size as u64, MAX_PICKLE_BYTES as u64);
        return Err(FieldError::Limit { what: "bytes of the pickle of a checkpoint", found, limit });
    }
    let pickled = entry.unpack(bytes)?;
    let loaded = pickle::load(&pickled, 0, "entry \"data.pkl\"")?;
    let names = names::of(&loaded)?;
    rebuild::tensors(&loaded, names, |storage| {
        let size = rebuild::storage_bytes(storage)?;
        let path = format!("data/{}", storage.key);
        let Some(entry) = inside.get(path.as_str()) else {
            return Err(fault(None, format!("the archive has no entry \"{root}{path}\" for a storage")));
        };
        if entry.size != size {
            let detail = format!("the entry {:?} has {} bytes where its storage has {size}", entry.name, entry.size);
            return Err(fault(None, detail));
        }
        entry.unpack(bytes).map(Cow::Owned)
    })
}

fn read_stream(bytes: &[u8]) -> Result<Tensors, FieldError> {
    let magic = pickle::load(bytes, 0, "magic number")?;
    if magic.root != Value::Long(&MAGIC) {
        return Err(fault(Some(0), "the magic number is not that of a stream"));
    }
    let version = pickle::load(bytes, magic.end, "version of the stream")?;
    if version.root != Value::Int(STREAM_VERSION) {
        return Err(fault(Some(magic.end), format!("the stream is not of version {STREAM_VERSION}")));
    }
    // the writer's machine, which says nothing of the numbers: they are always written little end first
    let machine = pickle::load(bytes, version.end, "description of the writer's machine")?;
    let loaded = pickle::load(bytes, machine.end, "pickle of the object")?;
    let keys = pickle::load(bytes, loaded.end, "list of storages")?;
    let names = names::of(&loaded)?;
    let places = storages_of_stream(bytes, &loaded, &keys)?;
    rebuild::tensors(&loaded, names, |storage| match places.get(storage.key) {
        Some(place) => Ok(Cow::Borrowed(*place)),
        None => Err(fault(None, format!("the storage {:?} is missing in the stream", storage.key))),
    })
}

/// The bytes of every storage by its key: after the list of keys each has its count of numbers and the numbers.
fn storages_of_stream<'a>(
    bytes: &'a [u8],
    loaded: &Loaded<'a>,
    keys: &Loaded<'a>,
) -> Result<HashMap<&'a str, &'a [u8]>, FieldError> {
    let known: HashMap<&str, &Storage<'_>> = loaded.storages.iter().map(|s| (s.key, s)).collect();
    let list = keys.sequence(keys.root).ok_or_else(|| fault(Some(loaded.end), "the storages are not a list"))?;
    let mut places = HashMap::with_capacity(known.len());
    let mut at = keys.end;
    for key in list {
        let storage = match *key {
            Value::Text(key) => known.get(key),
            _ => None,
        };
        let storage = storage.ok_or_else(|| fault(Some(at), "the list of storages names one that no tensor has"))?;
        let cut = || fault(Some(at), format!("the stream is cut short in the storage {:?}", storage.key));
        let count = bytes.get(at..).and_then(<[u8]>::first_chunk).map(|b| u64::from_le_bytes(*b)).ok_or_else(cut)?;
        if count != storage.count as u64 {
            let expected = storage.count;
            let detail = format!("the storage {:?} has {count} numbers instead of {expected}", storage.key);
            return Err(fault(Some(at), detail));
        }
        let start = at + size_of::<u64>();
        let size = rebuild::storage_bytes(storage)?;
        let place = start.checked_add(size).and_then(|end| bytes.get(start..end)).ok_or_else(cut)?;
        if places.insert(storage.key, place).is_some() {
            return Err(fault(Some(at), format!("the storage {:?} is there twice", storage.key)));
        }
        at = start + size;
    }
    Ok(places)
}
