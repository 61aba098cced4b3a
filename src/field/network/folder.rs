//! An experiment folder of DeepSDF as one file: a zip archive of `specs.json`, `ModelParameters/*.pth` and
//! `LatentCodes/*.pth`, in a folder of their own or not.

use super::family::{self, Detected, Hints, Specs};
use super::{Network, torch, zip};
use crate::field::FieldError;
use std::io::Write;
use std::path::Path;

const FORMAT: &str = "DeepSDF folder";
const SPECS: &str = "specs.json";
/// Longest `specs.json`.
const MAX_SPECS: usize = 1 << 20;
/// Checkpoint that is taken before all others.
const LATEST: &str = "latest.pth";

fn fault(detail: String) -> FieldError {
    FieldError::Malformed { format: FORMAT, at: None, detail }
}

/// The folder in which an archive's specs are, with its slash.
fn root(entries: &[zip::Entry]) -> Option<&str> {
    let is_root = |front: &&str| front.is_empty() || front.ends_with('/');
    entries.iter().filter_map(|e| e.name.strip_suffix(SPECS)).filter(is_root).min_by_key(|front| front.len())
}

/// Whether an archive is such a folder.
pub(in crate::field) fn claims(entries: &[zip::Entry]) -> bool {
    root(entries).is_some()
}

/// The checkpoint in a folder of the archive: `latest.pth`, or else the one with the largest number or the last name.
fn checkpoint<'a>(entries: &'a [zip::Entry], folder: &str) -> Option<&'a zip::Entry> {
    let in_folder =
        |e: &&zip::Entry| e.name.strip_prefix(folder).is_some_and(|n| n.ends_with(".pth") && !n.contains('/'));
    let rank = |e: &&zip::Entry| {
        let name = &e.name[folder.len()..];
        let number: Option<u64> = name.strip_suffix(".pth").and_then(|stem| stem.parse().ok());
        (name == LATEST, number, name.to_owned())
    };
    entries.iter().filter(in_folder).max_by_key(rank)
}

/// Reads the network of a folder.
///
/// # Errors
/// What the readers of its parts say, and [`FieldError::Malformed`] for a part that is missing.
pub fn read(bytes: &[u8], hints: &Hints) -> Result<(Network, Detected), FieldError> {
    let entries = zip::entries(bytes)?;
    let root = root(&entries).ok_or_else(|| fault(format!("there is no {SPECS}")))?;
    let specs = entries.iter().find(|e| e.name == format!("{root}{SPECS}"));
    let specs = specs.ok_or_else(|| fault(format!("there is no {SPECS}")))?;
    if specs.size > MAX_SPECS {
        let (found, limit) = (specs.size as u64, MAX_SPECS as u64);
        return Err(FieldError::Limit { what: "bytes of specs.json", found, limit });
    }
    let specs: Specs =
        serde_json::from_slice(&specs.unpack(bytes)?).map_err(|e| fault(format!("{root}{SPECS}: {e}")))?;
    let folder = format!("{root}ModelParameters/");
    let model = checkpoint(&entries, &folder).ok_or_else(|| fault(format!("there is no {folder}*.pth")))?;
    let model = torch::read(&model.unpack(bytes)?)?;
    let codes = checkpoint(&entries, &format!("{root}LatentCodes/"));
    let codes = codes.map(|entry| torch::read(&entry.unpack(bytes)?)).transpose()?;
    family::read(&model, codes.as_ref(), Some(&specs), hints)
}

/// An experiment folder on disk as the archive that [`read`] takes: its specs, and the checkpoint of each kind that would be
/// read.
///
/// # Errors
/// When a file cannot be read or there is no `specs.json`.
pub fn pack(folder: &Path) -> std::io::Result<Vec<u8>> {
    let mut names = vec![SPECS.to_owned()];
    for part in ["ModelParameters", "LatentCodes"] {
        let Ok(list) = std::fs::read_dir(folder.join(part)) else { continue };
        let mut found: Vec<String> = list
            .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
            .filter(|n| n.ends_with(".pth"))
            .collect();
        found.sort();
        if found.iter().any(|name| name == LATEST) {
            found.retain(|name| name == LATEST);
        }
        names.extend(found.into_iter().map(|name| format!("{part}/{name}")));
    }
    let named = |name: &str, error: std::io::Error| std::io::Error::new(error.kind(), format!("{name}: {error}"));
    let files =
        names.iter().map(|name| Ok((name.as_str(), std::fs::read(folder.join(name)).map_err(|e| named(name, e))?)));
    let files = files.collect::<std::io::Result<Vec<_>>>()?;
    zip_of(&files)
}

/// A zip archive of some files as they are (APPNOTE.TXT 4.3: local headers, a directory and its end).
fn zip_of(files: &[(&str, Vec<u8>)]) -> std::io::Result<Vec<u8>> {
    let too_large = || std::io::Error::other("the folder is too large for an archive");
    let (mut out, mut directory) = (Vec::new(), Vec::new());
    for (name, bytes) in files {
        let mut crc = flate2::Crc::new();
        crc.update(bytes);
        let (size, at) = (u32::try_from(bytes.len()), u32::try_from(out.len()));
        let (size, at) = (size.map_err(|_| too_large())?, at.map_err(|_| too_large())?);
        let length = u16::try_from(name.len()).map_err(|_| too_large())?;
        // version, flags, method (stored), time, date of 1980-01-01, checksum, both sizes, both lengths
        let mut common = Vec::new();
        [10u16, 0, 0, 0, 33].iter().for_each(|n| common.extend(n.to_le_bytes()));
        [crc.sum(), size, size].iter().for_each(|n| common.extend(n.to_le_bytes()));
        [length, 0].iter().for_each(|n| common.extend(n.to_le_bytes()));
        out.write_all(b"PK\x03\x04")?;
        out.extend_from_slice(&common);
        out.extend_from_slice(name.as_bytes());
        out.extend_from_slice(bytes);
        directory.write_all(b"PK\x01\x02\x0a\x00")?;
        directory.extend_from_slice(&common);
        // no comment, the first disk, no attributes
        directory.extend_from_slice(&[0; 10]);
        directory.extend_from_slice(&at.to_le_bytes());
        directory.extend_from_slice(name.as_bytes());
    }
    let count = u16::try_from(files.len()).map_err(|_| too_large())?.to_le_bytes();
    let (size, at) = (u32::try_from(directory.len()), u32::try_from(out.len()));
    let (size, at) = (size.map_err(|_| too_large())?.to_le_bytes(), at.map_err(|_| too_large())?.to_le_bytes());
    out.extend_from_slice(&directory);
    out.write_all(b"PK\x05\x06\0\0\0\0")?;
    for part in [&count[..], &count, &size, &at, &[0, 0]] {
        out.extend_from_slice(part);
    }
    Ok(out)
}
