//! Checks values against the bounds that their own JSON schema states.
//!
//! A parameter's range then stands in one place, an attribute of its field: the published schema, the contract and the
//! check all follow it.

use serde_json::Value;

use super::error::ReconError;

/// A value that is outside its bounds: a JSON pointer to it, and the error.
pub(crate) type Fault = (String, ReconError);

/// Compares `value` with `schema`, a part of the schema `root`. Understands references, tagged alternatives,
/// `minimum`, `maximum`, their exclusive forms, `minItems` and `maxItems`. Numbers are compared as `f32`.
pub(crate) fn check(value: &Value, schema: &Value, root: &Value, pointer: &str) -> Vec<Fault> {
    let target =
        schema["$ref"].as_str().and_then(|place| root.pointer(place.trim_start_matches('#')));
    let schema = target.unwrap_or(schema);
    let mut faults = Vec::new();
    match value {
        Value::Object(fields) => {
            let alternatives = schema["oneOf"].as_array().into_iter().flatten();
            for alternative in alternatives.filter(|alternative| matches_tag(value, alternative)) {
                faults.extend(check(value, alternative, root, pointer));
            }
            for (name, value) in fields {
                let place = format!("{pointer}/{name}");
                faults.extend(check(value, &schema["properties"][name], root, &place));
            }
        }
        Value::Array(items) => {
            faults.extend(range_fault(
                items.len() as f32,
                schema,
                ["minItems", "maxItems"],
                pointer,
            ));
            for (index, item) in items.iter().enumerate() {
                // A number in a short list has no name, so the fault points at the list.
                let place =
                    if item.is_object() { format!("{pointer}/{index}") } else { pointer.into() };
                faults.extend(check(item, &schema["items"], root, &place));
            }
        }
        Value::Number(number) => {
            let number = number.as_f64().unwrap_or(f64::NAN) as f32;
            faults.extend(range_fault(number, schema, ["minimum", "maximum"], pointer));
        }
        // JSON has no NaN and no infinity; they become null.
        Value::Null if schema["type"] == "number" => {
            faults.extend(range_fault(f32::NAN, schema, ["minimum", "maximum"], pointer));
        }
        _ => {}
    }
    faults.dedup_by(|one, other| one.0 == other.0);
    faults
}

/// Refuses the value of a field that does not have a type of its schema, or a list of the wrong length.
///
/// # Errors
/// A message that names the field and the types.
pub(crate) fn check_type(field: &str, value: &Value, schema: &Value) -> Result<(), String> {
    let types: Vec<&str> = match &schema["type"] {
        Value::Array(types) => types.iter().filter_map(Value::as_str).collect(),
        one => one.as_str().into_iter().collect(),
    };
    let is = |name: &&str| match *name {
        "null" => value.is_null(),
        "boolean" => value.is_boolean(),
        "integer" => value.is_u64(),
        "number" => value.is_number(),
        "string" => value.is_string(),
        "array" => value.is_array(),
        _ => true,
    };
    if !types.is_empty() && !types.iter().any(is) {
        let types = types.join(" or ");
        return Err(format!("{field}: invalid type: {value}, expected {types}"));
    }
    if value.as_f64().is_some_and(|value| value.abs() > f64::from(f32::MAX)) {
        return Err(format!("{field}: {value} is out of range"));
    }
    let Value::Array(items) = value else { return Ok(()) };
    let length = |bound: &str| schema[bound].as_u64();
    if length("minItems").is_some_and(|least| (items.len() as u64) < least)
        || length("maxItems").is_some_and(|most| items.len() as u64 > most)
    {
        let expected = length("minItems").unwrap_or_default();
        return Err(format!("{field}: invalid length {}, expected {expected}", items.len()));
    }
    items.iter().try_for_each(|item| check_type(field, item, &schema["items"]))
}

/// True if each constant property of `alternative` is that of `value`.
fn matches_tag(value: &Value, alternative: &Value) -> bool {
    let properties = alternative["properties"].as_object().into_iter().flatten();
    properties
        .filter(|(_, schema)| schema["const"].is_string())
        .all(|(name, schema)| value[name] == schema["const"])
}

/// The fault of a number, or of a list's length, that is outside `schema`'s bounds with these names.
fn range_fault(
    number: f32,
    schema: &Value,
    [least, most]: [&str; 2],
    pointer: &str,
) -> Option<Fault> {
    let bound = |name: &str| schema[name].as_f64().map(|bound| bound as f32);
    let bounds = [
        (bound(least), "at least", number >= bound(least).unwrap_or(f32::NEG_INFINITY)),
        (
            bound("exclusiveMinimum"),
            "above",
            number > bound("exclusiveMinimum").unwrap_or(f32::NEG_INFINITY),
        ),
        (bound(most), "at most", number <= bound(most).unwrap_or(f32::INFINITY)),
        (
            bound("exclusiveMaximum"),
            "below",
            number < bound("exclusiveMaximum").unwrap_or(f32::INFINITY),
        ),
    ];
    if bounds.iter().all(|(bound, _, holds)| bound.is_none() || *holds) {
        return None;
    }
    let range: Vec<String> = bounds
        .iter()
        .filter_map(|(bound, words, _)| Some(format!("{words} {}", (*bound)?)))
        .collect();
    let hint = schema["x-hint"].as_str().map_or_else(String::new, |hint| format!(" ({hint})"));
    let name = pointer.rsplit('/').next().unwrap_or_default().to_owned();
    let value =
        if least == "minItems" { format!("a list of {number}") } else { number.to_string() };
    let range = range.join(" and ") + &hint;
    Some((
        pointer.to_owned(),
        ReconError::Parameter { name: name.into(), value, range: range.into() },
    ))
}
