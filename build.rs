//! Generates the gRPC service from its contract, and for tests a client from the same file. Needs no `protoc`.

use std::path::PathBuf;

const CONTRACT: &str = "proto/shrinkd/v1/shrinkd.proto";

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo::rerun-if-changed={CONTRACT}");
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
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
