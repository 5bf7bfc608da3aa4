//! Names of enums as callers write them (serde has them; this reads and prints them), and numbers
//! and bytes as text.

use serde::{
    Deserialize,
    de::{IntoDeserializer, value::StrDeserializer},
};

/// The value that callers call `name`.
///
/// # Errors
/// A sentence that lists the names there are.
pub fn named<T: for<'de> Deserialize<'de>>(name: &str) -> Result<T, String> {
    let name: StrDeserializer<'_, serde::de::value::Error> = name.into_deserializer();
    T::deserialize(name).map_err(|error| error.to_string())
}

/// A number for a message: 1e308, not 309 digits.
pub fn shown(number: f64) -> String {
    let plain = number == 0.0 || !number.is_finite() || (1e-6..1e16).contains(&number.abs());
    if plain { number.to_string() } else { format!("{number:e}") }
}

/// Bytes as lower-case hexadecimal digits.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// `Display` by the names that serde gives an enum.
#[macro_export]
macro_rules! display_names {
    ($($name:ty),+ $(,)?) => {$(
        impl std::fmt::Display for $name {
            fn fmt(&self, to: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                ::serde::Serialize::serialize(self, to)
            }
        }
    )+};
}

pub use display_names;
