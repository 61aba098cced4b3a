//! `shrinkd compare`: wraps every field of a folder on every lattice that is asked for, measures each result beside marching
//! cubes of as many vertices on the same field, and writes a table and JSON as the results come, and contact sheets.
//!
//! A shape that fails, or that makes the program panic, is a row like any other. A shape that is refused for its topology is
//! counted by itself. Ctrl-C ends the shape at hand; what was done by then is written.

mod clocked;
mod one;
mod row;
mod shapes;
mod sheet;
mod side_by_side;
mod summary;

use super::{BAD_INPUT, CompareArgs, FAILED, fail, interrupt};
use crate::settings::CancelToken;
use crate::shrink::lattice::LatticeSpec;
use crate::surface::sheet::{COLUMNS, Tile, to_png};
use one::Pictures;
use row::Row;
use serde_json::{Map, Value, json};
use shapes::{Shape, find};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

/// Lattices when none is named: about 20,000 vertices each.
pub const LATTICES: [LatticeSpec; 2] =
    [LatticeSpec::Latlong { n_theta: 200, n_phi: 100 }, LatticeSpec::Octahedral { n: 72 }];

/// Runs the folder.
pub fn run(args: &CompareArgs) -> ExitCode {
    match compare(args) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(FAILED),
        Err((code, error)) => fail(code, &error),
    }
}

/// Whether every shape came out as expected; or an exit code and what to say.
fn compare(args: &CompareArgs) -> Result<bool, (u8, String)> {
    let in_folder = |detail: &dyn std::fmt::Display| (BAD_INPUT, format!("{}: {detail}", args.dir.display()));
    let found = find(&args.dir, &args.only).map_err(|e| in_folder(&e))?;
    if found.shapes.is_empty() {
        let passed_over = found.passed_over;
        return Err(in_folder(&format!("no field is here (of {passed_over} files looked at; see --only)")));
    }
    if let Some(out) = &args.out {
        std::fs::create_dir_all(out).map_err(|e| (FAILED, format!("{}: {e}", out.display())))?;
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads).build();
    let pool = pool.map_err(|e| (FAILED, e.to_string()))?;
    let stop = CancelToken::new();
    interrupt::raise_on_signal(&stop).map_err(|e| (FAILED, e.to_string()))?;
    let lattices = if args.lattice.is_empty() { LATTICES.to_vec() } else { args.lattice.clone() };

    let mut log = Log::new(args, &lattices)?;
    let mut unread = Vec::new();
    let task = one::Task {
        asked: args.shrink.spec(LATTICES[0]),
        budget: args.shrink.budget(),
        lattices: &lattices,
        baseline: !args.no_baseline,
        limit: args.limit.map(Duration::from_secs),
        expected: &args.expect_refusal,
        keep: args.out.as_deref().filter(|_| args.glb),
        draw: args.out.is_some(),
        side_by_side: args.side_by_side,
        pool: &pool,
        stop: &stop,
    };
    for shape in &found.shapes {
        if stop.is_canceled() {
            break;
        }
        match one::run(shape, &task, &mut |row, pictures| log.add(row, pictures)) {
            Ok(()) => {}
            Err(one::Ended::Unread(why)) => unread.push((shape.name.clone(), why)),
            Err(one::Ended::Stopped) => break,
            Err(one::Ended::Io(error)) => return Err((FAILED, error)),
        }
    }
    let interrupted = stop.is_canceled();
    log.finish(&found.shapes, &unread, interrupted)?;
    let good = log.rows.iter().all(|row| row.outcome.is_as_expected());
    Ok(good && !interrupted && !log.rows.is_empty())
}

/// Where rows go as they come.
struct Log<'a> {
    rows: Vec<Row>,
    /// Pictures of the rows, in the same order.
    pictures: Vec<Pictures>,
    side_by_side: bool,
    out: Option<&'a Path>,
    table: Option<(PathBuf, std::fs::File)>,
    json: Option<PathBuf>,
    lattices: &'a [LatticeSpec],
    dir: &'a Path,
    /// The options of wrapping, by their names in a request.
    options: Map<String, Value>,
}

impl<'a> Log<'a> {
    fn new(args: &'a CompareArgs, lattices: &'a [LatticeSpec]) -> Result<Self, (u8, String)> {
        let table = match &args.out {
            None => None,
            Some(out) => {
                let path = out.join("compare.md");
                let file = std::fs::File::create(&path).map_err(|e| told(&path, &e))?;
                Some((path, file))
            }
        };
        let json = args.json.clone().or_else(|| args.out.as_ref().map(|out| out.join("compare.json")));
        let mut log = Self {
            rows: Vec::new(),
            pictures: Vec::new(),
            side_by_side: args.side_by_side,
            out: args.out.as_deref(),
            table,
            json,
            lattices,
            dir: &args.dir,
            options: options(args),
        };
        log.say(&row::head(&log.options))?;
        Ok(log)
    }

    /// Writes text where the table goes: standard output, and the file if there is one.
    fn say(&mut self, text: &str) -> Result<(), (u8, String)> {
        let mut out = std::io::stdout().lock();
        // a reader that went away does not end the measurement
        let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
        if let Some((path, file)) = &mut self.table {
            file.write_all(text.as_bytes()).map_err(|e| told(path, &e))?;
        }
        Ok(())
    }

    fn add(&mut self, row: Row, pictures: Pictures) -> Result<(), String> {
        self.say(&row.to_markdown()).map_err(|e| e.1)?;
        self.rows.push(row);
        self.pictures.push(pictures);
        self.write_json(&[], true).map_err(|e| e.1)
    }

    fn finish(&mut self, shapes: &[Shape], unread: &[(String, String)], interrupted: bool) -> Result<(), (u8, String)> {
        let mut text = summary::to_markdown(&self.rows, self.lattices);
        if !unread.is_empty() {
            text.push_str("\nNot read as a surface, and not counted:\n\n");
            for (name, why) in unread {
                text.push_str(&format!("- {name}: {}\n", row::in_a_cell(why)));
            }
        }
        if interrupted {
            let (done, all) = (self.rows.len(), self.lattices.len() * (shapes.len() - unread.len()));
            text.push_str(&format!("\nInterrupted after {done} of {all} results.\n"));
        }
        if self.side_by_side {
            text.push_str(&side_by_side::to_markdown(&self.rows));
        }
        self.say(&text)?;
        self.write_json(unread, interrupted)?;
        self.write_sheets()
    }

    /// A contact sheet for every lattice.
    fn write_sheets(&mut self) -> Result<(), (u8, String)> {
        let Some(out) = self.out else { return Ok(()) };
        for &lattice in self.lattices {
            let rows = self.rows.iter().zip(&mut self.pictures).filter(|(row, _)| row.lattice == lattice);
            let (kind, columns) =
                if self.side_by_side { ("side-by-side", side_by_side::COLUMNS) } else { ("contact", COLUMNS) };
            let tiles: Vec<Tile> = rows
                .flat_map(|(row, pictures)| {
                    let pictures = std::mem::take(pictures);
                    match self.side_by_side {
                        true => side_by_side::tiles(row, pictures).to_vec(),
                        false => vec![sheet::tile(row, pictures.own)],
                    }
                })
                .collect();
            if !tiles.is_empty() {
                let path = out.join(format!("{kind}-{}.png", row::lattice_name(lattice).replace(':', "-")));
                std::fs::write(&path, to_png(&tiles, columns)).map_err(|e| told(&path, &e))?;
            }
        }
        Ok(())
    }

    /// Writes the whole document anew, beside and then over the old one, so that a reader never sees half of it.
    fn write_json(&self, unread: &[(String, String)], partial: bool) -> Result<(), (u8, String)> {
        let Some(path) = &self.json else { return Ok(()) };
        let unread: Vec<Value> = unread.iter().map(|(name, why)| json!({"shape": name, "why": why})).collect();
        let document = json!({
            "folder": self.dir.to_string_lossy(),
            "version": env!("CARGO_PKG_VERSION"),
            "options": self.options,
            "partial": partial,
            "rows": self.rows,
            "summary": summary::of(&self.rows, self.lattices),
            "unread": unread,
        });
        let mut beside = path.as_os_str().to_owned();
        beside.push(".part");
        let written = std::fs::write(&beside, format!("{document:#}\n"));
        written.and_then(|()| std::fs::rename(&beside, path)).map_err(|e| told(path, &e))
    }
}

/// What was asked of every shape, but for the lattices.
fn options(args: &CompareArgs) -> Map<String, Value> {
    let mut options = Map::new();
    for part in [json!(args.shrink.spec(LATTICES[0])), json!(args.shrink.budget())] {
        options.extend(part.as_object().cloned().unwrap_or_default());
    }
    options.retain(|name, value| name != "lattice" && !value.is_null());
    options
}

fn told(path: &Path, error: &std::io::Error) -> (u8, String) {
    (FAILED, format!("{}: {error}", path.display()))
}

/// Whether a text, such as a shape's path, is what a pattern asks for: a pattern with `*` (any run of characters) must fit
/// the whole text, one without must occur in it.
fn fits(pattern: &str, text: &str) -> bool {
    let mut parts = pattern.split('*');
    let first = parts.next().unwrap_or_default();
    let rest: Vec<&str> = parts.collect();
    let Some((last, middle)) = rest.split_last() else { return text.contains(pattern) };
    let Some(mut left) = text.strip_prefix(first) else { return false };
    for part in middle {
        // the earliest place leaves the most for the parts after it
        match left.find(part) {
            Some(at) => left = &left[at + part.len()..],
            None => return false,
        }
    }
    left.ends_with(last)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pattern_without_a_star_occurs_and_one_with_a_star_fits_whole() {
        for (pattern, text) in [
            ("spot", "paper/spot.ply"),
            ("genus/*", "genus/torus.ply"),
            ("*.ply", "a.ply"),
            ("a*b*c", "aXbXbc"),
            ("*", ""),
        ] {
            assert!(fits(pattern, text), "{pattern} {text}");
        }
        for (pattern, text) in
            [("genus/*", "x/genus/torus.ply"), ("*.ply", "a.ply.txt"), ("a*b*c", "aXc"), ("ab*b", "ab")]
        {
            assert!(!fits(pattern, text), "{pattern} {text}");
        }
    }

    #[test]
    fn the_lattices_have_about_twenty_thousand_vertices() {
        assert!(LATTICES.iter().all(|l| (19_000..21_000).contains(&l.vertices())));
    }
}
