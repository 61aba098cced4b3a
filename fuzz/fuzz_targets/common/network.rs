//! What every network that was read promises.

#[path = "field.rs"]
mod field;

use shrinkd::field::network::Network;

/// It has a field for the first of its latent codes, or for zeros.
pub fn can_be_evaluated(network: &Network) {
    let zeros = vec![0.0; network.latent_size];
    let code = network.latent_code(0).unwrap_or(&zeros);
    field::keeps_its_promises(&network.field(code).expect("a code of its size"));
}
