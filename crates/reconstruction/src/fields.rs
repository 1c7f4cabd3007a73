//! Structs that share one flat JSON object.

use std::fmt;
use std::marker::PhantomData;

use serde::de::{DeserializeOwned, DeserializeSeed, Error, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};
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

/// Reads the fields of an object one by one, so that an error carries the path of its field.
///
/// `check` receives the fields that precede, the name of the next one, and its value once that is read.
pub(crate) struct Reader<F>(pub(crate) F);

impl<'de, F: Fn(&Fields, &str, Option<&Value>) -> Result<(), String>> Visitor<'de> for Reader<F> {
    type Value = Fields;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut object: A) -> Result<Fields, A::Error> {
        let Self(check) = self;
        let mut fields = Fields::new();
        let checked_name = |fields: &Fields, name: &String| match fields.contains_key(name) {
            true => Err(format!("duplicate field `{name}`")),
            false => check(fields, name, None),
        };
        while let Some(name) =
            object.next_key_seed(Checked::new(|name: &String| checked_name(&fields, name)))?
        {
            let value = Checked::new(|value: &Value| check(&fields, &name, Some(value)));
            let value = object.next_value_seed(value)?;
            fields.insert(name, value);
        }
        Ok(fields)
    }
}

/// Deserializes a `T`, and refuses it if the check returns a message.
struct Checked<T, F> {
    check: F,
    value: PhantomData<T>,
}

impl<T, F: FnOnce(&T) -> Result<(), String>> Checked<T, F> {
    fn new(check: F) -> Self {
        Self { check, value: PhantomData }
    }
}

impl<'de, T, F> DeserializeSeed<'de> for Checked<T, F>
where
    T: Deserialize<'de>,
    F: FnOnce(&T) -> Result<(), String>,
{
    type Value = T;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<T, D::Error> {
        let value = T::deserialize(deserializer)?;
        (self.check)(&value).map_err(D::Error::custom)?;
        Ok(value)
    }
}
