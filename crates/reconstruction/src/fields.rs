//! Structs that share one flat JSON object.

use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

/// The fields of a JSON object.
pub(crate) type Fields = Map<String, Value>;

/// Reads a `T` from an object that may hold fields of other structs too.
///
/// # Errors
/// A message that names the field.
pub(crate) fn read<T: DeserializeOwned>(fields: &Fields) -> Result<T, String> {
    let object = Value::Object(fields.clone());
    serde_path_to_error::deserialize(object).map_err(|error| error.to_string())
}
