//! `shrinkd` turns a signed distance field into a parameterized surface: it contracts a sphere onto the zero level set and
//! keeps the sphere's coordinates as UVs.

pub mod auth;
pub mod blobs;
pub mod cli;
pub mod config;
pub mod engine;
pub mod extract;
pub mod field;
pub mod fit;
pub mod grpc;
pub mod http;
pub mod job;
pub mod measure;
pub mod notify;
pub mod quota;
pub mod settings;
pub mod shrink;
pub mod surface;
pub mod telemetry;
pub mod tenant;
