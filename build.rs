//! Generates the gRPC service from its contract, and for tests a client from the same file, without `protoc`; and takes the page that `web/`
//! builds into the program, where it was built.

use flate2::{Compression, write::GzEncoder};
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

const CONTRACT: &str = "proto/shrinkd/v1/shrinkd.proto";
/// Where `npm run build` in `web/` puts the page.
const PAGE: &str = "web/dist";
/// What that touches when it is done; a folder that is not there cannot be watched.
const PAGE_BUILT: &str = "web/index.html";

type Done = Result<(), Box<dyn std::error::Error>>;

fn main() -> Done {
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    contract(&out)?;
    page(&out)
}

fn contract(out: &Path) -> Done {
    println!("cargo::rerun-if-changed={CONTRACT}");
    let mut contract = protox::Compiler::new(["proto"])?;
    contract.include_imports(true).include_source_info(true).open_file(CONTRACT)?;
    // what reflection tells
    std::fs::write(out.join("contract.bin"), contract.encode_file_descriptor_set())?;
    for (folder, is_server) in [("server", true), ("client", false)] {
        let folder = out.join(folder);
        std::fs::create_dir_all(&folder)?;
        let generator = tonic_prost_build::configure().build_server(is_server).build_client(!is_server);
        generator.bytes(".shrinkd.v1").out_dir(folder).compile_fds(contract.file_descriptor_set())?;
    }
    Ok(())
}

/// Writes a list of the page's files, `(path, bytes, the same compressed by gzip)`; an empty one where there is no page.
fn page(out: &Path) -> Done {
    let root = Path::new(&std::env::var("CARGO_MANIFEST_DIR")?).join(PAGE);
    if Path::new(PAGE_BUILT).exists() {
        println!("cargo::rerun-if-changed={PAGE_BUILT}");
    }
    let mut files = Vec::new();
    if root.join("index.html").exists() {
        println!("cargo::rerun-if-changed={PAGE}");
        find(&root, &mut files)?;
        files.sort();
    }
    let mut list = String::from("&[\n");
    for (i, path) in files.iter().enumerate() {
        let name = path.strip_prefix(&root)?.to_str().ok_or("a name that is not Unicode")?;
        // copies, so that the page may be built anew while the program is compiled
        let [plain, packed] = ["plain", "gz"].map(|kind| out.join(format!("page-{i}.{kind}")));
        let bytes = std::fs::read(path)?;
        let mut encoder = GzEncoder::new(std::fs::File::create(&packed)?, Compression::best());
        encoder.write_all(&bytes)?;
        encoder.finish()?;
        std::fs::write(&plain, bytes)?;
        writeln!(list, "({name:?}, include_bytes!({plain:?}), include_bytes!({packed:?})),")?;
    }
    list.push(']');
    Ok(std::fs::write(out.join("page.rs"), list)?)
}

fn find(folder: &Path, files: &mut Vec<PathBuf>) -> std::io::Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() { find(&path, files)? } else { files.push(path) }
    }
    Ok(())
}
