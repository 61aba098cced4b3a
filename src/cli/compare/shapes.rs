//! The fields of a folder: every file below it whose content is of a known format.

use super::fits;
use crate::field::input::Format;
use std::io::Read as _;
use std::path::{Path, PathBuf};

/// Folders within folders at most, so that a link in a circle ends.
const MAX_DEPTH: usize = 16;
/// Bytes that tell a format from another.
const HEAD: u64 = 4096;

/// A file that claims to be a field.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Where it is.
    pub path: PathBuf,
    /// Its path from the folder that was asked for, with `/`.
    pub name: String,
    /// The part of the name before the last `/`; `.` for a file of the folder itself.
    pub folder: String,
}

/// What a folder holds.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Found {
    /// Files that claim to be fields, in the order of their names.
    pub shapes: Vec<Shape>,
    /// Files that do not, or that no pattern asked for.
    pub passed_over: usize,
}

/// Looks through a folder and the folders in it. Without patterns every shape is taken.
pub fn find(dir: &Path, only: &[String]) -> std::io::Result<Found> {
    let mut found = Found::default();
    walk(dir, "", 0, only, &mut found)?;
    found.shapes.sort_by(|a, b| (&a.folder, &a.name).cmp(&(&b.folder, &b.name)));
    Ok(found)
}

fn walk(dir: &Path, prefix: &str, depth: usize, only: &[String], found: &mut Found) -> std::io::Result<()> {
    for entry in std::fs::read_dir(dir)? {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if name.starts_with('.') {
            continue;
        }
        let name = if prefix.is_empty() { name } else { format!("{prefix}/{name}") };
        if path.is_dir() {
            if depth < MAX_DEPTH {
                walk(&path, &name, depth + 1, only, found)?;
            }
        } else if (only.is_empty() || only.iter().any(|pattern| fits(pattern, &name))) && claims(&path) {
            let folder = if prefix.is_empty() { "." } else { prefix }.to_owned();
            found.shapes.push(Shape { path, name, folder });
        } else {
            found.passed_over += 1;
        }
    }
    Ok(())
}

/// Whether the beginning of a file is of a known format. A binary STL is told by its whole length and an archive by its end,
/// so those are read whole.
fn claims(path: &Path) -> bool {
    let head = || -> std::io::Result<Vec<u8>> {
        let mut head = Vec::new();
        std::fs::File::open(path)?.take(HEAD).read_to_end(&mut head)?;
        Ok(head)
    };
    let known = |bytes: &[u8]| Format::detect(bytes).is_ok();
    head().is_ok_and(|bytes| {
        known(&bytes) || ((bytes.len() as u64) == HEAD && std::fs::read(path).is_ok_and(|all| known(&all)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_found_by_content_in_every_folder_and_in_order() {
        let folder = tempfile::tempdir().unwrap();
        let put = |name: &str, text: &str| {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        put("b/x.anything", r#"{"sphere": {"radius": 1}}"#);
        put("b/c/y.off", "OFF\n0 0 0\n");
        put("a.json", r#"{"sphere": {"radius": 1}}"#);
        put("notes.md", "# no field");
        put(".hidden/z.json", "{}");
        let names = |only: &[&str]| -> Vec<String> {
            let only: Vec<String> = only.iter().map(|&s| s.to_owned()).collect();
            find(folder.path(), &only).unwrap().shapes.into_iter().map(|s| s.name).collect()
        };
        assert_eq!(names(&[]), ["a.json", "b/x.anything", "b/c/y.off"]);
        assert_eq!(names(&["b/*"]), ["b/x.anything", "b/c/y.off"]);
        assert_eq!(find(folder.path(), &[]).unwrap().passed_over, 1);
        assert!(find(&folder.path().join("nowhere"), &[]).is_err());
    }
}
