//! (to be written)
pub(in crate::field) mod npy;
