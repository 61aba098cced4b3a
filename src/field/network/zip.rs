//! Entries of a zip archive, as `numpy.savez` and PyTorch write them: stored or deflated, no encryption, no spanning.
//!
//! Sizes are taken from the central directory and limited before anything is unpacked; an entry that unpacks to more or
//! less than it said, or to other bytes than its checksum says, is refused. Archives that need the 64-bit records are
//! over the size limit anyway.

use crate::field::FieldError;
use std::io::Read;

const FORMAT: &str = "zip";
const END: &[u8] = b"PK\x05\x06";
const CENTRAL: &[u8] = b"PK\x01\x02";
const LOCAL: &[u8] = b"PK\x03\x04";
/// Size of the end record without its comment, and the longest comment.
const END_SIZE: usize = 22;
const MAX_COMMENT: usize = 65_535;
/// Most entries: a PyTorch checkpoint has one for each tensor, and a few more.
const MAX_ENTRIES: usize = 4096;
/// Most bytes of all entries together, unpacked.
const MAX_UNPACKED: u64 = 1 << 30;
/// Deflate cannot do better than about 1,032 to 1; whoever claims more lies.
const MAX_RATIO: u64 = 1100;

/// One entry of the central directory.
pub(in crate::field) struct Entry {
    /// Its path in the archive.
    pub name: String,
    /// Bytes when unpacked.
    pub size: usize,
    method: u16,
    crc: u32,
    packed: usize,
    local: usize,
}

/// Whether the bytes begin as an archive does.
pub(in crate::field) fn claims(bytes: &[u8]) -> bool {
    bytes.starts_with(LOCAL)
}

fn fault(at: usize, detail: impl Into<String>) -> FieldError {
    FieldError::Malformed { format: FORMAT, at: Some(at as u64), detail: detail.into() }
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    bytes.get(at..)?.first_chunk().map(|b| u16::from_le_bytes(*b))
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..)?.first_chunk().map(|b| u32::from_le_bytes(*b))
}

/// The archive's entries, in the order of its directory.
pub(in crate::field) fn entries(bytes: &[u8]) -> Result<Vec<Entry>, FieldError> {
    let cut = || fault(bytes.len(), "the archive is cut short: its directory is missing");
    let last = bytes.len().checked_sub(END_SIZE).ok_or_else(cut)?;
    let first = last.saturating_sub(MAX_COMMENT);
    let end = (first..=last).rev().find(|&at| bytes[at..].starts_with(END)).ok_or_else(cut)?;
    let count = usize::from(u16_at(bytes, end + 10).unwrap_or(0));
    let mut at = u32_at(bytes, end + 16).unwrap_or(0) as usize;
    if count > MAX_ENTRIES {
        let (found, limit) = (count as u64, MAX_ENTRIES as u64);
        return Err(FieldError::Limit { what: "entries of an archive", found, limit });
    }
    let mut list = Vec::with_capacity(count);
    let mut total = 0u64;
    for _ in 0..count {
        let broken = || fault(at, "the archive's directory is broken here");
        let record = bytes.get(at..end).filter(|r| r.starts_with(CENTRAL) && r.len() >= 46).ok_or_else(broken)?;
        let short = |offset: usize| usize::from(u16_at(record, offset).unwrap_or(0));
        let long = |offset: usize| u32_at(record, offset).unwrap_or(0);
        let (name_size, extra, comment) = (short(28), short(30), short(32));
        let name = record.get(46..46 + name_size).ok_or_else(broken)?;
        let entry = Entry {
            name: String::from_utf8_lossy(name).into_owned(),
            size: long(24) as usize,
            method: short(10) as u16,
            crc: long(16),
            packed: long(20) as usize,
            local: long(42) as usize,
        };
        if short(8) & 1 != 0 {
            return Err(FieldError::Unsupported { detail: format!("the encrypted entry {:?}", entry.name) });
        }
        total += entry.size as u64;
        if total > MAX_UNPACKED {
            return Err(FieldError::Limit { what: "unpacked bytes of an archive", found: total, limit: MAX_UNPACKED });
        }
        if entry.size as u64 > MAX_RATIO * (entry.packed as u64 + 1) {
            return Err(fault(at, format!("entry {:?} claims to unpack to more than deflate can", entry.name)));
        }
        list.push(entry);
        at += 46 + name_size + extra + comment;
    }
    Ok(list)
}

impl Entry {
    /// The unpacked bytes of this entry of the archive `bytes`.
    pub fn unpack(&self, bytes: &[u8]) -> Result<Vec<u8>, FieldError> {
        let broken = |detail: &str| fault(self.local, format!("entry {:?}: {detail}", self.name));
        let header =
            bytes.get(self.local..).filter(|h| h.starts_with(LOCAL)).ok_or_else(|| broken("no entry begins here"))?;
        let (Some(name), Some(extra)) = (u16_at(header, 26), u16_at(header, 28)) else {
            return Err(broken("the archive ends here"));
        };
        let start = 30 + usize::from(name) + usize::from(extra);
        let packed = header.get(start..start + self.packed).ok_or_else(|| broken("its bytes pass the end"))?;
        let unpacked = match self.method {
            0 if self.packed == self.size => packed.to_vec(),
            8 => {
                let mut unpacked = Vec::with_capacity(self.size);
                // one byte more than promised is enough to see that there is more
                let mut reader = flate2::read::DeflateDecoder::new(packed).take(self.size as u64 + 1);
                reader.read_to_end(&mut unpacked).map_err(|_| broken("its deflated bytes are broken"))?;
                unpacked
            }
            0 => return Err(broken("it is stored with two different sizes")),
            other => {
                let detail = format!("compression method {other} of the entry {:?}", self.name);
                return Err(FieldError::Unsupported { detail });
            }
        };
        if unpacked.len() != self.size {
            return Err(broken("it does not unpack to the size it says"));
        }
        let mut crc = flate2::Crc::new();
        crc.update(&unpacked);
        if crc.sum() != self.crc {
            return Err(broken("its checksum does not hold"));
        }
        Ok(unpacked)
    }
}
