//! The cryptography of TLS, chosen once for the server, its store and its spans.

use tokio_rustls::rustls::crypto::ring;

/// Makes `ring` the provider of every TLS connection of this process. Safe to call again.
pub fn install() {
    // An error says that a provider is there already.
    drop(ring::default_provider().install_default());
}
