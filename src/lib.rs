//! `shrinkd` turns a signed distance field into a parameterized surface: it contracts a sphere onto the zero level set and
//! keeps the sphere's coordinates as UVs.

pub mod field;
pub mod measure;
pub mod settings;
pub mod shrink;
pub mod surface;
